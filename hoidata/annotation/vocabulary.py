"""Verbs, objects and hand types of the training clips, stored in every checkpoint."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from hoidata.batches.dataset import ClipSample


@dataclass(frozen=True)
class Vocabulary:
    """Numbers of training clips by content."""

    counts: Mapping[tuple[str, str, str], int]  # by (verb, object words, hand type)

    @classmethod
    def of(cls, samples: Iterable[ClipSample]) -> "Vocabulary":
        return cls(Counter((sample.verb or "", sample.object_words, sample.hand_type) for sample in samples))

    @classmethod
    def read(cls, facts: Mapping[str, Any]) -> "Vocabulary":
        """From the facts of a checkpoint."""
        return cls({(verb, noun, hand): count for verb, noun, hand, count in facts.get("vocabulary", [])})

    def __add__(self, other: "Vocabulary") -> "Vocabulary":
        return Vocabulary(Counter(self.counts) + Counter(other.counts))

    @property
    def rows(self) -> list[list[str | int]]:
        """For the facts of a checkpoint: verb, object words, hand type, number of clips."""
        return [[*key, count] for key, count in sorted(self.counts.items())]

    @property
    def verbs(self) -> Counter[str]:
        return self._clips_by(0)

    @property
    def verb_names(self) -> list[str]:
        """The verbs in alphabetical order, without clips that have none."""
        return sorted(filter(None, self.verbs))

    @property
    def objects(self) -> Counter[str]:
        return self._clips_by(1)

    def _clips_by(self, column: int) -> Counter[str]:
        counts: Counter[str] = Counter()
        for key, count in self.counts.items():
            counts[key[column]] += count
        return counts

    def knows(self, verb: str | None, object_words: str | None) -> int:
        """Score of how well the training clips cover a sentence; larger is better.

        A known verb counts more than any object. Then come an object seen with this verb, a known object, and one with
        the same head noun, such as "bottle" and "water bottle".
        """
        seen_together = any(key[:2] == (verb, object_words) for key in self.counts)
        head_noun = (object_words or "").split()[-1:]
        same_kind = bool(head_noun) and any(other.split()[-1:] == head_noun for other in self.objects)
        return 8 * (verb in self.verbs) + 4 * seen_together + 2 * (object_words in self.objects) + same_kind
