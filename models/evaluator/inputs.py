"""Inputs of the evaluator networks, and the recorded clips they are trained on.

``paper`` follows the released code of Text2HOI: 15 frames of 42 joints, without the object. ``corrected`` adds the
object's motion, but not its shape: the label could be read from the shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from hoidata.clips.clip import SIDES, Side
from hoidata.clips.features import OBJECT_ROTATION_6D, object_features, upright
from hoidata.files import canonical_json
from hoidata.geometry.rotations import rot6d_to_rotmat, rotation_angles_about
from hoidata.metrics.encoded import UNKNOWN, recorded_motions
from hoidata.metrics.pair import Motion
from hoidata.metrics.paths import FRAMES, JOINTS, even_frames, joints_and_presence
from hoidata.objects.surface_index import surface_index
from hoidata.store.annotated import AnnotatedStore

FRAME_STEP = 3
FAR_M = 0.10
PAPER_SIZE = JOINTS * 3
OBJECT = slice(PAPER_SIZE, PAPER_SIZE + 11)  # position 3, 6D rotation 6, hinge 1, heading relative to frame 0 1
CORRECTED_SIZE = OBJECT.stop + JOINTS
CACHED_MOTIONS = 128


def random_frames(n_frames: int, fractions: np.ndarray) -> np.ndarray:
    """(15,) one frame from each of 15 equal segments, at (15,) ``fractions`` in [0, 1) of its segment."""
    edges = np.linspace(0, n_frames, FRAMES + 1)
    return np.minimum(edges[:-1] + fractions * np.diff(edges), n_frames - 1).astype(np.int64)


def paper_input(joints: np.ndarray, present: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(15, 126) float32 joints relative to a wrist, metres; absent joints are 0.

    The wrist is that of the right hand if it acts, else of the left, in the first chosen frame in which it is present.

    Args:
        joints: (frame, 42, 3) upright world, metres.
        present: (frame, 42) bool.
        frames: (15,) chosen frames.
    """
    chosen, visible = joints[frames], present[frames]
    wrist = JOINTS // 2 if visible[:, JOINTS // 2].any() else 0
    placed = np.where(visible[..., None], chosen - chosen[visible[:, wrist].argmax(), wrist], 0.0)
    return placed.reshape(len(frames), -1).astype(np.float32)


@lru_cache(maxsize=CACHED_MOTIONS)
def corrected_input(motion: Motion, sides: tuple[Side, ...]) -> np.ndarray:
    """(step, 179) float32 at 10 steps per second: joints, object pose and the distance of each joint to the object.

    Positions are in the upright frame with the object's first position at zero. The heading of a clip is arbitrary, so
    the accumulated rotation about the vertical is given separately in radians: from two rotations of arbitrary heading
    a network does not learn whether a lid is screwed on or off. Cached, because two networks use it.
    """
    joints, present = joints_and_presence(motion, sides)
    frames = np.arange(len(joints))[::FRAME_STEP]
    clip, visible, upright_rotation = motion.clip, present[frames], upright(motion.clip.gravity)
    origin = clip.object.translation_m[0].astype(np.float64)
    objects = object_features(clip.object.take(frames), upright_rotation, origin)
    positions = np.where(visible[..., None], joints[frames] - upright_rotation @ origin, 0.0)
    distances_m = np.concatenate([_distances_m(motion, side, frames) for side in SIDES], axis=1)
    distances_m = np.where(visible, distances_m, FAR_M)
    turns_rad = rotation_angles_about(rot6d_to_rotmat(objects[:, OBJECT_ROTATION_6D]), np.array((0.0, 0.0, 1.0)))
    heading_rad = np.concatenate(([0.0], np.cumsum(turns_rad)))[:, None]  # unwrapped: full rotations add up
    columns = (positions.reshape(len(frames), -1), objects, heading_rad, distances_m)
    return np.concatenate(columns, axis=1).astype(np.float32)


def _distances_m(motion: Motion, side: Side, frames: np.ndarray) -> np.ndarray:
    """(step, 21) distance of the joints of one hand to the surface, capped at 0.10 m."""
    index = surface_index(motion.clip.object.model)
    positions = motion.joints_in_object(side, frames)
    return np.minimum(index.distance_m(positions, motion.hinge_rad(frames), FAR_M), FAR_M)


@dataclass(frozen=True)
class Examples:
    """The recorded clips of one part of a split, as network inputs and labels."""

    ids: list[str]
    steps: list[np.ndarray]  # per clip (step, 179), ``corrected_input``; empty if no network reads them
    joints: list[tuple[np.ndarray, np.ndarray]]  # per clip (frame, 42, 3) joints and (frame, 42) presence
    text: np.ndarray  # (clip, 4, 512) features of the sentences
    verbs: list[str | None]
    objects: list[str]  # in words
    hands: list[str]  # hand types

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, annotated: AnnotatedStore, split: str, joints_only: bool = False) -> "Examples":
        """The clips of a part that have a verb; joints_only: without ``steps``, which take longest to compute."""
        verbs = {clip_id: annotated.verb(clip_id) for clip_id in annotated.ids(split)}
        ids = [clip_id for clip_id, verb in verbs.items() if verb]
        recordings = list(recorded_motions(annotated, ids))
        text = [annotated.text_embedding(clip_id) for clip_id in ids]
        return cls(
            ids,
            [] if joints_only else [corrected_input(item.motion, item.sides) for item in recordings],
            [joints_and_presence(item.motion, item.sides) for item in recordings],
            np.stack(text) if text else np.zeros((0, 4, 512), np.float32),
            [verbs[clip_id] for clip_id in ids],
            annotated.store.sequences.loc[ids, "object_words"].tolist(),
            [annotated.hand_type(clip_id) for clip_id in ids],
        )

    def digest(self) -> str:
        """SHA-256 of all fields."""
        digest = sha256(canonical_json([self.ids, self.verbs, self.objects, self.hands]).encode())
        for array in (*self.steps, *(part for arrays in self.joints for part in arrays), self.text):
            digest.update(np.ascontiguousarray(array).data)
        return digest.hexdigest()

    @property
    def trained_verbs(self) -> tuple[str, ...]:
        """The verbs of these clips in alphabetical order: the labels of a classifier trained on them."""
        return tuple(sorted({verb for verb in self.verbs if verb}))

    def labels(self, names: Sequence[str]) -> Tensor:
        """(clip,) index of each clip's verb in ``names``, ``UNKNOWN`` for others."""
        return torch.tensor([names.index(verb) if verb in names else UNKNOWN for verb in self.verbs])

    def prompts(self) -> Tensor:
        """(clip,) number of the prompt; clips with the same verb, object and hand have the same prompt."""
        prompts = list(zip(self.verbs, self.objects, self.hands, strict=True))
        number_of = {prompt: number for number, prompt in enumerate(sorted(set(prompts), key=str))}
        return torch.tensor([number_of[prompt] for prompt in prompts])

    def evaluation_inputs(self, trunk: str, rows: Sequence[int] | Tensor) -> tuple[Tensor, Tensor]:
        """Padded inputs of the clips ``rows`` and their numbers of steps, as in evaluation."""
        if trunk == "recurrent":
            return padded([self.steps[index] for index in rows])
        clips = [self.joints[index] for index in rows]
        return padded([paper_input(joints, present, even_frames(len(joints))) for joints, present in clips])

    def random_inputs(
        self, trunk: str, rows: Sequence[int] | Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """As ``evaluation_inputs``, for training: ``planar`` gets randomly sampled frames."""
        if trunk == "recurrent":
            return self.evaluation_inputs(trunk, rows)
        clips = [self.joints[index] for index in rows]
        fractions = torch.rand(len(clips), FRAMES, generator=generator, dtype=torch.float64).numpy()
        return padded(
            [
                paper_input(joints, present, random_frames(len(joints), clip_fractions))
                for (joints, present), clip_fractions in zip(clips, fractions, strict=True)
            ]
        )


def padded(motions: Sequence[np.ndarray]) -> tuple[Tensor, Tensor]:
    """Inputs of different lengths as (motion, step, size), zero-padded at the end, and (motion,) lengths."""
    tensors = [torch.from_numpy(np.asarray(motion, np.float32)) for motion in motions]
    return pad_sequence(tensors, batch_first=True), torch.tensor([len(motion) for motion in tensors])
