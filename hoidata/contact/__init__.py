"""Contact between hands and objects: acting hands, contact maps, sparse distance maps."""

from hoidata.contact.hands import HandEvidence, acting_hands
from hoidata.contact.maps import contact_maps, dense_distances, distance_entries, frame_contact, touched_frames
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ENTRY, ProximityIndex

__all__ = [
    "CONTACT_THRESHOLD_M",
    "ENTRY",
    "HandEvidence",
    "ProximityIndex",
    "acting_hands",
    "contact_maps",
    "dense_distances",
    "distance_entries",
    "frame_contact",
    "touched_frames",
]
