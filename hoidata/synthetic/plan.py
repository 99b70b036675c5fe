"""Who does what, how often: subjects, their shares, and the actions each performs."""

from typing import Literal, NamedTuple

from hoidata.synthetic.actions import ACTIONS

Size = Literal["full", "small"]
DATASET_IDS = {"h2o": 1, "grab": 2, "arctic": 3}


class Entry(NamedTuple):
    """subject; action: row of ACTIONS[dataset]; number: how many times this subject did it before, from 1."""

    subject: str
    action: int
    number: int


class Cast(NamedTuple):
    """Subjects of the training, validation and test splits, and how many actions each split has."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]
    counts: tuple[int, int, int]


CASTS: dict[str, dict[Size, Cast]] = {
    "h2o": {
        "full": Cast(("subject1",), ("subject2",), ("subject3",), (40, 13, 18)),
        "small": Cast(("subject1",), ("subject2",), ("subject3",), (4, 2, 2)),
    },
    "grab": {
        "full": Cast(tuple(f"s{n}" for n in range(1, 9)), ("s9",), ("s10",), (60, 15, 25)),
        "small": Cast(("s1", "s2"), ("s9",), ("s10",), (4, 2, 2)),
    },
    "arctic": {
        "full": Cast(("s01", "s02", "s04", "s06", "s07", "s08"), ("s05",), ("s10",), (48, 12, 20)),
        "small": Cast(("s01", "s02"), ("s05",), ("s10",), (4, 2, 2)),
    },
}
_ACTIONS_OF = {"full": 1000, "small": 3}


def subjects(dataset: str, size: Size) -> tuple[str, ...]:
    cast = CASTS[dataset][size]
    return (*cast.train, *cast.validation, *cast.test)


def plan(dataset: str, size: Size) -> list[Entry]:
    """All actions of a corpus, in order. Every action of validation and test also happens in training."""
    cast = CASTS[dataset][size]
    n_actions = min(_ACTIONS_OF[size], len(ACTIONS[dataset]))
    if cast.counts[0] < n_actions:
        raise ValueError(f"{dataset} {size}: {cast.counts[0]} training actions cannot show {n_actions} pairs")
    entries: list[Entry] = []
    for split, (names, count) in enumerate(zip(cast[:3], cast.counts, strict=True)):
        for index in range(count):
            # Another prime step per split, so that a short split does not always begin with the same actions.
            action = (index + 5 * split) % n_actions
            subject = names[(index + index // n_actions) % len(names)]
            done = sum(entry.subject == subject and entry.action == action for entry in entries)
            entries.append(Entry(subject, action, done + 1))
    return entries
