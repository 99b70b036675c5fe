"""Recorded clips as the networks of the evaluator are trained on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from hoidata.actions.action import verb_of
from hoidata.files import canonical_json
from hoidata.metrics.encoded import UNKNOWN, label_words, recorded
from hoidata.metrics.paths import FRAMES, even_frames, joints_and_presence
from hoidata.store.annotated import AnnotatedStore
from models.evaluator.inputs import corrected_input, drawn_frames, paper_input


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

    def label_words(self, kind: str) -> list[str | None]:
        return label_words(kind, self.verbs, self.objects)

    def labels(self, kind: str, known: Sequence[str]) -> Tensor:
        """(clip,) index of each clip's label among the known ones, ``UNKNOWN`` for others."""
        return torch.tensor([known.index(word) if word in known else UNKNOWN for word in self.label_words(kind)])

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
