"""What models have been told about in training: verbs, objects and hands of their clips, kept in every checkpoint."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from hoidata.batches.dataset import ClipSample


@dataclass(frozen=True)
class Vocabulary:
    """What training clips were about. counts: clips by (verb, object words, hand type)."""

    counts: Mapping[tuple[str, str, str], int]

    @classmethod
    def of(cls, samples: Iterable[ClipSample]) -> "Vocabulary":
        return cls(Counter((sample.verb or "", sample.object_words, sample.hand_type) for sample in samples))

    @classmethod
    def read(cls, facts: Mapping[str, Any]) -> "Vocabulary":
        """From what a checkpoint records."""
        return cls({(verb, thing, hand): count for verb, thing, hand, count in facts.get("vocabulary", [])})

    def __add__(self, other: "Vocabulary") -> "Vocabulary":
        return Vocabulary(Counter(self.counts) + Counter(other.counts))

    @property
    def rows(self) -> list[list[str | int]]:
        """What a checkpoint records: verb, object, hand type, clips."""
        return [[*key, count] for key, count in sorted(self.counts.items())]

    @property
    def verbs(self) -> Counter[str]:
        return self._clips_by(0)

    @property
    def objects(self) -> Counter[str]:
        return self._clips_by(1)

    def _clips_by(self, column: int) -> Counter[str]:
        found: Counter[str] = Counter()
        for key, count in self.counts.items():
            found[key[column]] += count
        return found

    def knows(self, verb: str | None, object_words: str | None) -> int:
        """How well training clips fit a sentence. Its verb counts most: one of training beats any object.

        Then an object that was seen with this verb, seen at all, or of the same kind ("bottle" and "water bottle").
        """
        both = any(key[:2] == (verb, object_words) for key in self.counts)
        kind = (object_words or "").split()[-1:]
        alike = bool(kind) and any(other.split()[-1:] == kind for other in self.objects)
        return 8 * (verb in self.verbs) + 4 * both + 2 * (object_words in self.objects) + alike
