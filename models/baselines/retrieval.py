"""Retrieval baselines: a training clip chosen by sentence, prompt, verb or hand, or deliberately a wrong one."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.store.annotated import AnnotatedStore
from models.common.family import Family, SingleRequestSampler, Skipped, Sources, motion_clip

Train = Sequence[ClipSample]


@dataclass(frozen=True)
class Retrieval(SingleRequestSampler):
    """Answers motion k of a request with the k-th training clip of a ranking.

    The motion is stretched to the requested length and applied to the requested object.
    """

    train: Train
    rank: Callable[[Train, Request], Sequence[int] | np.ndarray]  # rows of the training clips, best first
    kind: str = ""  # the clips that ``rank`` looks for, in words
    use_retrieved_hands: bool = False  # move the hands of the retrieved clip, not only the requested ones

    def motion(self, request: Request) -> Clip | Skipped:
        """The retrieved motion, or the reason if no clip matches."""
        indices = self.rank(self.train, request) if len(self.train) else []
        if not len(indices):
            return Skipped(request.motion_id, f"no training clip {self.kind}")
        retrieved = self.train[indices[request.number % len(indices)]]
        frames = matched_rows(request.n_frames, retrieved.length)
        hands, objects = torch.from_numpy(retrieved.hands[:, frames]), torch.from_numpy(retrieved.object[frames])
        adapted = replace(request, active_hands=retrieved.valid.all(1)) if self.use_retrieved_hands else request
        return motion_clip(adapted, hands, objects, retrieved.synthetic)


@dataclass(frozen=True)
class Prompt:
    """Ranks training clips by the verb and the object of a request."""

    annotated: AnnotatedStore

    def prompt_overlap(self, train: Train, request: Request) -> np.ndarray:
        """(clip,) 2 for training clips with the verb and object of the request, 1 with one of them, 0 with neither."""
        verb, object_key = self._of(request)
        return np.array([(sample.verb == verb) + (sample.object_key == object_key) for sample in train])

    def other_verb(self, train: Train, request: Request) -> Sequence[int]:
        """Clips of the same hand and another verb, those of the same object first."""
        verb, object_key = self._of(request)
        indices = [index for index in of_the_hand(train, request) if train[index].verb != verb]
        return sorted(indices, key=lambda index: train[index].object_key != object_key)

    def same(self, train: Train, request: Request) -> Sequence[int] | np.ndarray:
        """Clips of the same verb, object and hand; if there is none, all clips by sentence."""
        overlap = self.prompt_overlap(train, request)
        return [index for index in of_the_hand(train, request) if overlap[index] == 2] or by_sentence(train, request)

    def same_verb(self, train: Train, request: Request) -> Sequence[int]:
        """Clips of the same verb and hand with any object; those of the same object first."""
        verb, object_key = self._of(request)
        indices = [index for index in of_the_hand(train, request) if train[index].verb == verb]
        return sorted(indices, key=lambda index: train[index].object_key != object_key)

    def other_hand(self, train: Train, request: Request) -> Sequence[int]:
        """Clips in which a requested hand is valid but inactive; those of the same verb and object first."""
        overlap = self.prompt_overlap(train, request)
        others = [
            index for index in shuffled(len(train), request)
            if (request.active_hands & ~train[index].active_hands).any()
            and train[index].valid[request.active_hands].all()
        ]  # fmt: skip
        return sorted(others, key=lambda index: -overlap[index])

    def _of(self, request: Request) -> tuple[str | None, str]:
        return self.annotated.verb(request.clip_id), self.annotated.object_key(request.clip_id)


def by_sentence(train: Train, request: Request) -> np.ndarray:
    """All clips, those with the same hands first, then by cosine similarity of the sentence features."""
    features = np.stack([sample.text[0] for sample in train])
    features = features / np.linalg.norm(features, axis=1, keepdims=True)
    similarity = features @ (request.text / np.linalg.norm(request.text))
    same = np.array([(sample.active_hands == request.active_hands).all() for sample in train])
    return np.lexsort((-similarity, ~same))


def of_the_hand(train: Train, request: Request) -> list[int]:
    """Clips with the same hands, in the random order of ``shuffled``."""
    indices = shuffled(len(train), request)
    return [index for index in indices if (train[index].active_hands == request.active_hands).all()]


def shuffled(count: int, request: Request) -> list[int]:
    """``count`` rows in a random order that is the same for all motions of one clip."""
    seed = int.from_bytes(hashlib.sha256(request.clip_id.encode()).digest()[:8])
    return np.random.default_rng(seed).permutation(count).tolist()


def matched_rows(n_frames: int, length: int) -> np.ndarray:
    """(n_frames,) for each frame of a motion, the frame at the same fraction of another motion's ``length``."""
    return np.arange(n_frames) * length // max(n_frames, 1)


def retrieval_clips(sources: Sources) -> list[ClipSample]:
    """The training clips with all hands tracked: values of an untracked hand are not a motion."""
    return [sample for sample in sources.clips("train") if sample.is_tracked]


def _family(name: str, title: str, load: Callable[[Train, Prompt], Retrieval]) -> Family:
    return Family(name, title, lambda sources: load(retrieval_clips(sources), Prompt(sources.annotated)))


NEAREST_CLIP = _family("nearest-clip", "retrieval by sentence", lambda train, prompt: Retrieval(train, by_sentence))
PROMPT_LOOKUP = _family("prompt-retrieval", "retrieval by prompt", lambda train, prompt: Retrieval(train, prompt.same))
VERB_LOOKUP = _family(
    "verb-retrieval",
    "retrieval by verb",
    lambda train, prompt: Retrieval(train, prompt.same_verb, "of this hand with this verb"),
)
RANDOM_CLIP = _family(
    "random-clip", "random training clip", lambda train, prompt: Retrieval(train, of_the_hand, "of this hand")
)
OTHER_VERB = _family(
    "other-verb",
    "retrieval of another verb",
    lambda train, prompt: Retrieval(train, prompt.other_verb, "of this hand with another verb"),
)
SWAPPED_HANDS = _family(
    "swapped-hands",
    "retrieval of other hands",
    lambda train, prompt: Retrieval(
        train, prompt.other_hand, "in which a hand asked for is idle and seen", use_retrieved_hands=True
    ),
)
