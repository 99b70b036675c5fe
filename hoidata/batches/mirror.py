"""Recorded clips seen in a mirror: right-handed ones teach left hands, and each object stands for two shapes.

The mirror has the normal x, in every frame: a rotation R becomes S R S with S = diag(-1, 1, 1), as MANO's left hand is
its right one (``hoidata.hands.embedded.mirrored``). A hinge keeps its angles; its axis, no place but a turn, becomes
-S axis.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from cachetools import LRUCache, cachedmethod

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.features import HAND_ROTATIONS_6D, OBJECT_POSITION, OBJECT_ROTATION_6D, WRIST
from hoidata.objects.model import Hinge, ObjectModel

MOST_BYTES = 1 << 30  # of a long clip every window is a sample of its own
PLACE = np.array([-1.0, 1.0, 1.0], np.float32)
# Two columns of a rotation, row by row, as ``rotmat_to_rot6d`` flattens them: entry (i, j) has sign S_i S_j.
ROTATION_6D = (PLACE[:, None] * PLACE[:2]).reshape(6)
OTHER = {"left": "right", "right": "left", "both": "both"}
# What these do is something else in a mirror: a lid that is screwed on comes off.
HANDED_VERBS = frozenset({"screw", "unscrew", "screw in", "screw on", "tighten", "loosen", "wind"})


@dataclass(frozen=True)
class Mirror:
    """Makes mirrored samples and keeps the last. text: features (512,) of every sentence that is known."""

    text: dict[str, np.ndarray]
    made: LRUCache = field(default_factory=lambda: LRUCache(MOST_BYTES, _bytes))

    @classmethod
    def of(cls, samples: Iterable[ClipSample]) -> "Mirror":
        """The sentences of these clips; a clip of the one hand can be mirrored where the other hand does the same."""
        return cls({words: row for sample in samples for words, row in zip(sample.sentences, sample.text, strict=True)})

    @cachedmethod(lambda self: self.made, key=lambda self, sample: sample.key)
    def mirrored(self, sample: ClipSample) -> ClipSample | None:
        """The sample in the mirror; None where the other hand is not known to do the same."""
        sentences = tuple(map(swap_hands, sample.sentences))
        if sample.verb in HANDED_VERBS or not all(words in self.text for words in sentences):
            return None
        hands = sample.hands[::-1].copy()
        hands[..., WRIST] *= PLACE
        hands[..., HAND_ROTATIONS_6D] *= np.tile(ROTATION_6D, 16)
        thing, near, points = sample.object.copy(), sample.distances, sample.points
        thing[:, OBJECT_POSITION] *= PLACE
        thing[:, OBJECT_ROTATION_6D] *= ROTATION_6D
        template = None if sample.template_m is None else sample.template_m[::-1] * PLACE
        return replace(
            sample,
            clip_id=f"{sample.clip_id} in a mirror",
            object_key=f"{sample.object_key} in a mirror",
            object_model=mirrored_object(sample.object_model),
            hand_type=OTHER[sample.hand_type],
            sentences=sentences,
            hands=hands,
            object=thing,
            joints_m=sample.joints_m[::-1] * PLACE,
            valid=sample.valid[::-1].copy(),
            active_hands=sample.active_hands[::-1].copy(),
            betas=sample.betas[::-1].copy(),
            template_m=template,
            text=np.stack([self.text[words] for words in sentences]),
            points=ObjectPoints(points.points_m * PLACE, points.normals * PLACE, points.part),
            contact=sample.contact[::-1].copy(),
            distances=replace(near, side=1 - near.side),
        )


def _bytes(sample: ClipSample | None) -> int:
    return sample.nbytes if sample else 1


def mirrored_object(model: ObjectModel) -> ObjectModel:
    """The object in the mirror, faces still counter-clockwise from outside."""
    hinge = model.hinge
    if hinge is not None:
        hinge = Hinge(-np.asarray(hinge.axis) * PLACE, np.asarray(hinge.origin_m) * PLACE)
    faces = np.ascontiguousarray(model.faces[:, ::-1])
    return replace(model, vertices_m=model.vertices_m * PLACE, faces=faces, hinge=hinge)


def swap_hands(sentence: str) -> str:
    """The sentence with the other hand; as it is where it names both hands, or none."""
    parts = sentence.split("left hand")
    return "right hand".join(part.replace("right hand", "left hand") for part in parts)
