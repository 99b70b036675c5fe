"""What the inputs alone give away: the label most common in training given object, hand, both or nothing."""

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence

Row = tuple[str, str, str]  # label, object, hand of one clip
INPUTS: dict[str, Callable[[Row], tuple[str, ...]]] = {
    "nothing": lambda row: (),
    "object": lambda row: row[1:2],
    "hand": lambda row: row[2:],
    "object and hand": lambda row: row[1:],
}


def majority_rows(train: Sequence[Row], test: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Per input, how often a test clip's label is the most common (top1) or among the three most common in training.

    Of equally common labels the first by name comes first; an input that was never met is answered with all clips'.
    """
    return {name: _accuracy(train, test, key) for name, key in INPUTS.items()} if train and test else {}


def ranked_labels(train: Sequence[Row], key: Callable[[Row], tuple[str, ...]]) -> dict[tuple[str, ...], list[str]]:
    """By input, the labels of training clips from the most common on."""
    counts: defaultdict[tuple[str, ...], Counter[str]] = defaultdict(Counter)
    for row in train:
        counts[key(row)][row[0]] += 1
    return {given: sorted(found, key=lambda label: (-found[label], label)) for given, found in counts.items()}


def _accuracy(train: Sequence[Row], test: Sequence[Row], key: Callable[[Row], tuple[str, ...]]) -> dict[str, float]:
    known, usual = ranked_labels(train, key), ranked_labels(train, INPUTS["nothing"])[()]
    guesses = [known.get(key(row), usual) for row in test]
    hits = {k: sum(row[0] in guess[:k] for row, guess in zip(test, guesses, strict=True)) for k in (1, 3)}
    return {f"top{k}": round(count / len(test), 4) for k, count in hits.items()}
