"""Rivals that look a motion up among the training clips: by sentence, by prompt, by hand alone, or the wrong one."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.store.annotated import AnnotatedStore
from models.common.family import EachAlone, Family, LeftOut, Sources, motion_clip

Train = Sequence[ClipSample]


@dataclass(frozen=True)
class Lookup(EachAlone):
    """Training clips in the order a ranking gives: its first for the first motion, its second for the second.

    The clip's motion is stretched to the length asked for and carried over to the object asked for. rank: from the
    training clips and a request to rows of the former, none where there is none of the ``kind`` that is sought.
    as_found: whether the hands move that acted there, not those that were asked for alone.
    """

    train: Train
    rank: Callable[[Train, Request], Sequence[int] | np.ndarray]
    kind: str = ""
    as_found: bool = False

    def motion(self, request: Request) -> Clip | LeftOut:
        """The motion of the clip that is found, or that there is none."""
        rows = self.rank(self.train, request) if len(self.train) else []
        if not len(rows):
            return LeftOut(request.motion_id, f"no training clip {self.kind}")
        found = self.train[rows[request.number % len(rows)]]
        frames = matched_rows(request.n_frames, found.length)
        hands, objects = torch.from_numpy(found.hands[:, frames]), torch.from_numpy(found.object[frames])
        asked = replace(request, active_hands=found.valid.all(1)) if self.as_found else request
        return motion_clip(asked, hands, objects, found.synthetic)


@dataclass(frozen=True)
class Prompt:
    """What a recorded clip is told apart by, beside its hand: its verb and its object."""

    annotated: AnnotatedStore

    def nearness(self, train: Train, request: Request) -> np.ndarray:
        """(clip,) 2 for training clips of the request's verb and object, 1 of its verb or object, 0 of neither."""
        verb, thing = self._of(request)
        return np.array([(sample.verb == verb) + (sample.object_key == thing) for sample in train])

    def other_verb(self, train: Train, request: Request) -> Sequence[int]:
        """Clips of the same hand and another verb, those of the same object first."""
        verb, thing = self._of(request)
        rows = [row for row in of_the_hand(train, request) if train[row].verb != verb]
        return sorted(rows, key=lambda row: train[row].object_key != thing)

    def same(self, train: Train, request: Request) -> Sequence[int] | np.ndarray:
        """Clips of the same verb, object and hand; by sentence where there is none."""
        nearness = self.nearness(train, request)
        return [row for row in of_the_hand(train, request) if nearness[row] == 2] or by_sentence(train, request)

    def same_verb(self, train: Train, request: Request) -> Sequence[int]:
        """Clips of the same verb and hand, on whatever object; those of the same object first."""
        verb, thing = self._of(request)
        rows = [row for row in of_the_hand(train, request) if train[row].verb == verb]
        return sorted(rows, key=lambda row: train[row].object_key != thing)

    def other_hand(self, train: Train, request: Request) -> Sequence[int]:
        """Clips in which a hand asked for is seen and does not act; those of the same verb and object first."""
        nearness = self.nearness(train, request)
        others = [
            row for row in drawn(len(train), request)
            if (request.active_hands & ~train[row].active_hands).any()
            and train[row].valid[request.active_hands].all()
        ]  # fmt: skip
        return sorted(others, key=lambda row: -nearness[row])

    def _of(self, request: Request) -> tuple[str | None, str]:
        row = self.annotated.store.sequences.loc[request.clip_id]
        return row["verb"], str(row["object"])


def by_sentence(train: Train, request: Request) -> np.ndarray:
    """All clips: those of the same hands first, then by similarity of the sentence."""
    features = np.stack([sample.text[0] for sample in train])
    features = features / np.linalg.norm(features, axis=1, keepdims=True)
    similarity = features @ (request.text / np.linalg.norm(request.text))
    same = np.array([(sample.active_hands == request.active_hands).all() for sample in train])
    return np.lexsort((-similarity, ~same))


def of_the_hand(train: Train, request: Request) -> list[int]:
    """Clips of the same hands, in an order drawn for the clip whose place the motion takes."""
    rows = drawn(len(train), request)
    return [row for row in rows if (train[row].active_hands == request.active_hands).all()]


def drawn(count: int, request: Request) -> list[int]:
    """``count`` rows in an order that is the same for all motions asked in the place of one clip."""
    seed = int.from_bytes(hashlib.sha256(request.clip_id.encode()).digest()[:8])
    return np.random.default_rng(seed).permutation(count).tolist()


def matched_rows(n_frames: int, length: int) -> np.ndarray:
    """(n_frames,) for each frame of a motion the row at the same share of another's ``length``."""
    return np.arange(n_frames) * length // max(n_frames, 1)


def train_clips(sources: Sources) -> list[ClipSample]:
    """The training clips, of long ones the first frames."""
    return list(HoiDataset(sources.annotated, "train", crop="start"))


def lookup_clips(sources: Sources) -> list[ClipSample]:
    """The training clips whose motion can be copied: numbers of a hand that is not tracked are no motion."""
    return [sample for sample in train_clips(sources) if sample.is_tracked]


def _family(name: str, title: str, load: Callable[[Train, Prompt], Lookup]) -> Family:
    return Family(name, title, lambda sources: load(lookup_clips(sources), Prompt(sources.annotated)))


NEAREST_CLIP = _family("nearest-clip", "nearest training clip", lambda train, prompt: Lookup(train, by_sentence))
PROMPT_LOOKUP = _family(
    "prompt-lookup", "training clip of the prompt", lambda train, prompt: Lookup(train, prompt.same)
)
VERB_LOOKUP = _family(
    "verb-lookup",
    "training clip of the verb",
    lambda train, prompt: Lookup(train, prompt.same_verb, "of this hand with this verb"),
)
RANDOM_CLIP = _family(
    "random-clip", "random training clip", lambda train, prompt: Lookup(train, of_the_hand, "of this hand")
)
OTHER_VERB = _family(
    "other-verb",
    "training clip of another verb",
    lambda train, prompt: Lookup(train, prompt.other_verb, "of this hand with another verb"),
)
SWAPPED_HANDS = _family(
    "swapped-hands",
    "training clip of other hands",
    lambda train, prompt: Lookup(train, prompt.other_hand, "in which a hand asked for is idle and seen", as_found=True),
)
