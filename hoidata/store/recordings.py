"""Converts whole recordings to and from the arrays of ``arrays/recordings.npz`` and ``arrays/source_hands.npz``."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hoidata.clips.clip import SIDES, ObjectTrack, SourceFile
from hoidata.clips.recording import HandRecording, SourceHandTrack
from hoidata.files import canonical_json, sha256_bytes
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.store.fields import RECORDINGS, SOURCE_HANDS

_DIGITS = 16
# Members with the name of their attribute.
_OF_HAND = ("parents", "offset_m", "rest_rotmats", "tip_joint", "wrist_from_canonical", "hinge_axis", "limit_rad")
_OF_CAPSULES = ("joint", "start_m", "end_m", "radius_m")


class RecordingWriter:
    """Collects the arrays of recordings and of their hands; each distinct hand once."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self.hands: dict[str, np.ndarray] = {}
        self.facts: dict[str, dict[str, Any]] = {}
        self.hand_facts: dict[str, dict[str, Any]] = {}

    def add(self, recording: HandRecording, object_key: Any, source_files: list[int]) -> None:
        """Add a recording. It replaces an earlier recording of the same sequence."""
        by_name = _recording_arrays(recording)
        for field in RECORDINGS.fields:
            self.arrays[f"{recording.sequence}/{field.name}"] = np.ascontiguousarray(by_name[field.name], field.dtype)
        self.facts[recording.sequence] = {
            "subject": recording.subject,
            "fps": recording.fps,
            "frames": recording.n_frames,
            "object": object_key,
            "hand": self._add_hand(recording.hand),
            "gravity": recording.gravity.tolist(),
            "source_files": source_files,
        }

    def _add_hand(self, hand: TrackedHand) -> str:
        arrays = {f.name: np.ascontiguousarray(_hand_arrays(hand)[f.name], f.dtype) for f in SOURCE_HANDS.fields}
        names = {"layout": hand.layout, "joints": list(hand.joint_names), "middle_knuckle": hand.middle_knuckle}
        parts = [canonical_json(names).encode(), *(array.tobytes() for array in arrays.values())]
        key = sha256_bytes(b"".join(parts))[:_DIGITS]
        self.hands |= {f"{key}/{name}": array for name, array in arrays.items()}
        self.hand_facts[key] = names
        return key


def _recording_arrays(recording: HandRecording) -> dict[str, np.ndarray]:
    track = recording.object
    hinge = np.zeros(track.n_frames) if track.hinge_rad is None else track.hinge_rad
    arrays = {"object_rotvec": track.rotvec, "object_translation_m": track.translation_m, "object_hinge_rad": hinge}
    for side, hand in recording.hands.items():
        arrays |= {f"{side}_wrist_m": hand.wrist_m, f"{side}_rotvec": hand.rotvec}
    return arrays | {"usable": recording.usable}


def read_recording(
    sequence: str,
    dataset: str,
    facts: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    hand: TrackedHand,
    model: ObjectModel,
    sources: tuple[SourceFile, ...],
) -> HandRecording:
    """Rebuild the recording of one sequence from its facts in info.json and the members of recordings.npz."""
    members = {field.name: arrays[f"{sequence}/{field.name}"].copy() for field in RECORDINGS.fields}
    hinge = members["object_hinge_rad"] if model.is_articulated else None
    return HandRecording(
        dataset=dataset,
        subject=facts["subject"],
        sequence=sequence,
        fps=facts["fps"],
        hand=hand,
        hands={side: SourceHandTrack(members[f"{side}_wrist_m"], members[f"{side}_rotvec"]) for side in SIDES},
        object=ObjectTrack(model, members["object_rotvec"], members["object_translation_m"], hinge),
        usable=members["usable"],
        gravity=np.array(facts["gravity"]),
        sources=sources,
    )


def _hand_arrays(hand: TrackedHand) -> dict[str, np.ndarray]:
    skin, capsules = hand.skin, hand.capsules
    if skin.corrective_m is not None:
        raise ValueError("a hand with pose blend shapes is stored by its model's digest, not by its arrays")
    return {
        **{name: getattr(hand, name) for name in _OF_HAND},
        **{f"capsule_{name}": getattr(capsules, name) for name in _OF_CAPSULES},
        "skin_point_m": skin.point_m,
        "skin_normal": skin.normal,
        "skin_weight": skin.weight,
        "joint_from_skin": skin.joint_from_skin.rotation,
        "joint_from_skin_m": skin.joint_from_skin.translation,
    }


def read_hand(key: str, facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> TrackedHand:
    """Rebuild a right hand from its facts in info.json and the members of source_hands.npz."""
    members = {field.name: arrays[f"{key}/{field.name}"].copy() for field in SOURCE_HANDS.fields}
    to_joint = RigidTransform(members["joint_from_skin"], members["joint_from_skin_m"])
    return TrackedHand(
        side="right",
        layout=facts["layout"],
        joint_names=tuple(facts["joints"]),
        skin=Skin(members["skin_point_m"], members["skin_normal"], members["skin_weight"], to_joint),
        capsules=JointCapsules(*(members[f"capsule_{name}"] for name in _OF_CAPSULES)),
        middle_knuckle=facts["middle_knuckle"],
        **{name: members[name] for name in _OF_HAND},
    )
