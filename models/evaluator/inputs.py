"""What the networks of the evaluator see of a motion, as arrays, and recorded clips as they are trained on them.

``paper`` is the rule Text2HOI left in its released code (facts sheet 3.2): 15 frames of 42 joints, no object.
``corrected`` sees the object too, but not its shape, from which the label could be read (sheet 6.1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from hoidata.actions.action import verb_of
from hoidata.clips.clip import SIDES, Side
from hoidata.clips.features import OBJECT_ROTATION_6D, object_features, upright
from hoidata.files import canonical_json
from hoidata.geometry.rotations import rot6d_to_rotmat, turns_about
from hoidata.metrics.encoded import UNKNOWN, recorded
from hoidata.metrics.pair import Motion
from hoidata.metrics.paths import FRAMES, JOINTS, even_frames, joints_and_presence
from hoidata.objects.surface_index import surface_index
from hoidata.store.annotated import AnnotatedStore

EVERY = 3
FAR_M = 0.10
PAPER_SIZE = JOINTS * 3
OBJECT = slice(PAPER_SIZE, PAPER_SIZE + 11)  # position 3, 6D 6, hinge 1, turn about the upright since the first frame 1
CORRECTED_SIZE = OBJECT.stop + JOINTS
MOTIONS_KEPT = 128


def drawn_frames(n_frames: int, shares: np.ndarray) -> np.ndarray:
    """(15,) one frame of each of 15 groups in a row. shares: (15,) where in its group, from 0 to below 1."""
    edges = np.linspace(0, n_frames, FRAMES + 1)
    return np.minimum(edges[:-1] + shares * np.diff(edges), n_frames - 1).astype(np.int64)


def paper_input(joints: np.ndarray, present: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(15, 126) float32: joints less the wrist of the first frame (the right one if that hand acts), absent ones 0.

    First: of the frames in which that wrist is seen.
    """
    chosen, seen = joints[frames], present[frames]
    wrist = JOINTS // 2 if seen[:, JOINTS // 2].any() else 0
    placed = np.where(seen[..., None], chosen - chosen[seen[:, wrist].argmax(), wrist], 0.0)
    return placed.reshape(len(frames), -1).astype(np.float32)


@lru_cache(maxsize=MOTIONS_KEPT)
def corrected_input(motion: Motion, sides: tuple[Side, ...]) -> np.ndarray:
    """(step, 179) float32: joints and object in the clip frame at 10 per second, and how near each joint is.

    Clip frame: upright, the object's first position at zero; which way a clip faces means nothing. Hence the turn as a
    number of its own, radians: of two rotations that may face any way, a network does not learn whether a lid is
    screwed on or off. Kept for the last motions: two networks ask for it.
    """
    joints, present = joints_and_presence(motion, sides)
    frames = np.arange(len(joints))[::EVERY]
    clip, seen, turn = motion.clip, present[frames], upright(motion.clip.gravity)
    origin = clip.object.translation_m[0].astype(np.float64)
    objects = object_features(clip.object.take(frames), turn, origin)
    placed = np.where(seen[..., None], joints[frames] - turn @ origin, 0.0)
    near = np.where(seen, np.concatenate([_distances_m(motion, side, frames) for side in SIDES], axis=1), FAR_M)
    steps = turns_about(rot6d_to_rotmat(objects[:, OBJECT_ROTATION_6D]), np.array((0.0, 0.0, 1.0)))
    facing = np.concatenate(([0.0], np.cumsum(steps)))[:, None]  # whole turns counted
    return np.concatenate((placed.reshape(len(frames), -1), objects, facing, near), axis=1).astype(np.float32)


def _distances_m(motion: Motion, side: Side, frames: np.ndarray) -> np.ndarray:
    """(step, 21) distance of the joints of one hand to the surface, at most 0.10 m."""
    index = surface_index(motion.clip.object.model)
    positions = motion.joints_in_object(side, frames)
    return np.minimum(index.distance_m(positions, motion.hinge_rad(frames), FAR_M), FAR_M)


@dataclass(frozen=True)
class Examples:
    """Clips of one part of a split. steps: per clip (step, 179); joints: per clip (frame, 42, 3) and (frame, 42).

    text (clip, 4, 512): features of the sentences. verbs, objects, hands: in words, per clip.
    """

    ids: list[str]
    steps: list[np.ndarray]
    joints: list[tuple[np.ndarray, np.ndarray]]
    text: np.ndarray
    verbs: list[str | None]
    objects: list[str]
    hands: list[str]

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, annotated: AnnotatedStore, split: str) -> "Examples":
        """All clips of a part that have a verb."""
        verbs = {clip_id: verb_of(annotated, clip_id) for clip_id in annotated.ids(split)}
        ids = [clip_id for clip_id, verb in verbs.items() if verb]
        asked = list(recorded(annotated, ids))
        text = [annotated.text_embedding(clip_id) for clip_id in ids]
        return cls(
            ids,
            [corrected_input(item.motion, item.sides) for item in asked],
            [joints_and_presence(item.motion, item.sides) for item in asked],
            np.stack(text) if text else np.zeros((0, 4, 512), np.float32),
            [verbs[clip_id] for clip_id in ids],
            annotated.store.sequences.loc[ids, "object_words"].tolist(),
            [annotated.hand_type(clip_id) for clip_id in ids],
        )

    def digest(self) -> str:
        """SHA-256 of everything that is here."""
        found = sha256(canonical_json([self.ids, self.verbs, self.objects, self.hands]).encode())
        for array in (*self.steps, *(part for own in self.joints for part in own), self.text):
            found.update(np.ascontiguousarray(array).data)
        return found.hexdigest()

    @property
    def known_verbs(self) -> tuple[str, ...]:
        """The labels of classifiers that are trained on these clips, in order."""
        return tuple(sorted({verb for verb in self.verbs if verb}))

    def labels(self, known: Sequence[str]) -> Tensor:
        """(clip,) index of each clip's verb among the known ones, ``UNKNOWN`` for others."""
        return torch.tensor([known.index(verb) if verb in known else UNKNOWN for verb in self.verbs])

    def prompts(self) -> Tensor:
        """(clip,) a number per prompt: clips of which verb, object and hand are the same share it."""
        rows = list(zip(self.verbs, self.objects, self.hands, strict=True))
        known = {row: number for number, row in enumerate(sorted(set(rows), key=str))}
        return torch.tensor([known[row] for row in rows])

    def whole(self, trunk: str, rows: Sequence[int] | Tensor) -> tuple[Tensor, Tensor]:
        """Inputs and their numbers of steps, as in evaluation."""
        if trunk == "recurrent":
            return padded([self.steps[row] for row in rows])
        found = [self.joints[row] for row in rows]
        return padded([paper_input(*own, even_frames(len(own[0]))) for own in found])

    def drawn(self, trunk: str, rows: Sequence[int] | Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """The same as one training step sees them: of ``planar`` other frames each time."""
        if trunk == "recurrent":
            return self.whole(trunk, rows)
        found = [self.joints[row] for row in rows]
        shares = torch.rand(len(found), FRAMES, generator=generator, dtype=torch.float64).numpy()
        frames = [drawn_frames(len(own[0]), share) for own, share in zip(found, shares, strict=True)]
        return padded([paper_input(*own, chosen) for own, chosen in zip(found, frames, strict=True)])


def padded(motions: Sequence[np.ndarray]) -> tuple[Tensor, Tensor]:
    """Inputs of different length as (motion, step, size) with zeros behind, and (motion,) lengths."""
    tensors = [torch.from_numpy(np.asarray(motion, np.float32)) for motion in motions]
    return pad_sequence(tensors, batch_first=True), torch.tensor([len(motion) for motion in tensors])
