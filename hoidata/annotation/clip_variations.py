"""Guarded variations for the clips of a dataset: which sentences a clip gets, and when one may say slowly or quickly.

Off by default. The choice rests on clip id and sentence alone, so a clip keeps its variations whatever clips stand
beside it, and asking for more of them adds to those it has. Only the guard looks at the dataset: it reads a sentence
back among the dataset's words.
"""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from hoidata.annotation.sentences import UNLABELLED_VERB
from hoidata.annotation.variations import Loss, Manner, SentenceMaker, manner_of
from hoidata.clips import FPS, HandType
from hoidata.errors import BadInput

# Speed over a tenth of a second: over one frame a millimetre of jitter alone would be 4 cm/s.
STEP_FRAMES = 3
# The slowest and the quickest fifth may say so, where they also differ from the middle by a quarter: of clips that are
# all about equally fast, none is slow.
QUANTILES = (0.2, 0.8)
SLOWER, QUICKER = 0.75, 1.25
# Of fewer clips with one verb a fifth says little; the whole dataset's speeds are taken instead.
FEWEST_CLIPS = 10


@dataclass(frozen=True)
class VariationSettings:
    """per_clip: at most so many for each clip, 0 for none. adverbs: whether measured speeds may be named."""

    per_clip: int = 0
    adverbs: bool = True

    def __post_init__(self) -> None:
        if self.per_clip < 0:
            raise BadInput("annotate.variations.per_clip", "0 or more sentences", f"{self.per_clip}", "correct it")


@dataclass(frozen=True)
class Wording:
    """What a clip's sentences say. speed_m_s: of its acting hands, None where it was not measured.

    taken: sentences the clip has already; a variation is never one of them.
    """

    clip_id: str
    verb: str | None
    object_words: str
    hand: HandType
    speed_m_s: float | None = None
    taken: Sequence[str] = ()


@dataclass
class ClipVariations:
    """sentences: by clip id, in the order they were drawn. dropped: sentences the guard refused while drawing.

    manners: clips that may say slowly or quickly.
    """

    sentences: dict[str, tuple[str, ...]] = field(default_factory=dict)
    dropped: Counter[str] = field(default_factory=Counter)
    manners: Counter[str] = field(default_factory=Counter)

    def facts(self) -> dict[str, Any]:
        """Counts as plain values."""
        return {
            "kept": sum(map(len, self.sentences.values())),
            "dropped": {loss: self.dropped[loss] for loss in ("hand", "verb", "object")},
            **{manner: self.manners[manner] for manner in ("slowly", "quickly")},
        }


def clip_variations(wordings: Sequence[Wording], settings: VariationSettings) -> ClipVariations:
    """Up to ``settings.per_clip`` variations for each clip, in the order of a digest of clip id and sentence.

    With ``settings.adverbs`` a clip whose measured speed stands out (see ``manners``) may say slowly or quickly.
    """
    found = ClipVariations()
    if settings.per_clip == 0 or not wordings:
        return found
    drawer = _Drawer(wordings)
    manner_of_clip = manners(wordings) if settings.adverbs else {}
    for wording in wordings:
        manner = manner_of_clip.get(wording.clip_id)
        kept, dropped = drawer.draw(wording, manner, settings.per_clip)
        found.sentences[wording.clip_id] = kept
        found.dropped.update(dropped)
        found.manners.update([manner] if manner else [])
    return found


class _Drawer:
    """Draws guarded sentences; what clips have in common is made and read back once."""

    def __init__(self, wordings: Sequence[Wording]) -> None:
        said = [_said(wording) for wording in wordings]
        self._maker = SentenceMaker((verb for verb, _, _ in said), (noun for _, noun, _ in said))
        self._unguarded = lru_cache(maxsize=None)(self._maker.unguarded)
        self._lost = lru_cache(maxsize=None)(self._maker.lost)

    def draw(self, wording: Wording, manner: Manner | None, count: int) -> tuple[tuple[str, ...], list[Loss]]:
        """The first ``count`` sentences of the clip's own order that read back, and why others before them did not."""
        said = _said(wording)
        kept, dropped = [], []
        for sentence in _drawn(wording.clip_id, set(self._unguarded(*said, manner)) - set(wording.taken)):
            if len(kept) == count:
                break
            loss = self._lost(sentence, *said)
            if loss is None:
                kept.append(sentence)
            else:
                dropped.append(loss)
        return tuple(kept), dropped


def _said(wording: Wording) -> tuple[str, str, HandType]:
    verb = UNLABELLED_VERB if wording.verb is None else wording.verb
    return " ".join(verb.split()), " ".join(wording.object_words.split()), wording.hand


def manners(wordings: Sequence[Wording]) -> dict[str, Manner]:
    """Clips that are slow or quick among the dataset's own clips with the same verb, or among all where those are few.

    Slow: in the slowest fifth and at most 0.75 of the median; quick: in the quickest fifth and at least 1.25 of it.
    """
    speeds: dict[str | None, list[float]] = {}
    everything: list[float] = []
    for wording in wordings:
        if wording.speed_m_s is not None:
            speeds.setdefault(wording.verb, []).append(wording.speed_m_s)
            everything.append(wording.speed_m_s)
    limits = {verb: _limits(own if len(own) >= FEWEST_CLIPS else everything) for verb, own in speeds.items()}
    found: dict[str, Manner] = {}
    for wording in wordings:
        if wording.speed_m_s is not None:
            manner = manner_of(wording.speed_m_s, limits[wording.verb])
            if manner:
                found[wording.clip_id] = manner
    return found


def _limits(speeds: Sequence[float]) -> tuple[float, float]:
    """Below the first slow, above the second quick; of fewer than ten clips none is either."""
    if len(speeds) < FEWEST_CLIPS:
        return -np.inf, np.inf
    slow, middle, quick = np.quantile(speeds, (QUANTILES[0], 0.5, QUANTILES[1]))
    return float(min(slow, SLOWER * middle)), float(max(quick, QUICKER * middle))


def hand_speed_m_s(joints_m: Mapping[Any, np.ndarray], valid: Mapping[Any, np.ndarray]) -> float | None:
    """Mean speed of all joints of the acting hands, metres per second over steps of 0.1 s; None without such a step.

    joints_m: by acting hand (frame, joint, 3) in the world; valid: by hand (frame,) bool. Steps with an end in an
    invalid frame do not count.
    """
    speeds = []
    for hand, joints in joints_m.items():
        sound = valid[hand][STEP_FRAMES:] & valid[hand][:-STEP_FRAMES]
        steps = np.asarray(joints[STEP_FRAMES:], np.float64) - joints[:-STEP_FRAMES]
        speeds.append(np.linalg.norm(steps[sound], axis=-1).ravel())
    moved = np.concatenate(speeds) if speeds else np.zeros(0)
    return float(moved.mean()) * FPS / STEP_FRAMES if len(moved) else None


def _drawn(clip_id: str, sentences: set[str]) -> list[str]:
    """The sentences in an order of the clip's own."""
    return sorted(sentences, key=lambda sentence: hashlib.sha256(f"{clip_id}\n{sentence}".encode()).digest())
