"""Plan of the corpus ``study``: verbs crossed with objects, hands and regions, over disjoint subjects.

In contrast to the embedded corpora, object and hand do not determine the verb. Verb, object and hand do not determine
the grasped region.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from hoidata.clips.clip import HandType
from hoidata.synthetic.actions import DATASET_IDS
from hoidata.synthetic.paths import Key, Motion, Swing
from hoidata.synthetic.study_objects import STUDY_OBJECTS, Region, StudyObject

StudySize = Literal["study", "study-small"]
_UP = (0.0, 0.0, 0.17)
_TILTED = (-25.0, 0.0, 0.0)


@dataclass(frozen=True)
class StudyVerb:
    """A verb and its object motion."""

    intent: str  # as in the files of GRAB
    length: float  # mean frames of contact at 30 fps
    motion: Motion  # hinge values are fractions of the range
    two_hands: Motion | None = None  # motion with both hands, if different
    heading_deg: float = 0.0  # maximum rotation of the path about the vertical

    def motion_of(self, hand: HandType) -> Motion:
        return self.two_hands if hand == "both" and self.two_hands is not None else self.motion


def _there_and_back(*middle: Key, swing: Swing | None = None) -> Motion:
    return Motion((Key(0), Key(0.08), *middle, Key(0.96), Key(1)), swing)


def _turned(degrees: float) -> Motion:
    return Motion((Key(0), Key(0.15), Key(0.85, rotation_deg=(0, 0, degrees)), Key(1, rotation_deg=(0, 0, degrees))))


def _moving_lid(start: float, stop: float) -> tuple[Motion, Motion]:
    """Return the motions on the table, and lifted between two hands."""
    up = (0.0, 0.0, 0.09)
    on_table = (Key(0, hinge=start), Key(0.35, hinge=start), Key(0.65, hinge=stop), Key(1, hinge=stop))
    lifted = (
        Key(0, hinge=start), Key(0.1, hinge=start), Key(0.4, up, _TILTED, start), Key(0.62, up, _TILTED, stop),
        Key(0.95, hinge=stop), Key(1, hinge=stop),
    )  # fmt: skip
    return Motion(on_table), Motion(lifted)


_POURED, _DRUNK = Key(0.45, (-0.06, 0.05, 0.2), (0, -80, 0)), Key(0.44, (0, -0.18, 0.26), (42, 0, 0))
_SHOWN = Key(0.2, (0, -0.1, 0.17))
VERBS = {
    "lift": StudyVerb("lift", 52, _there_and_back(Key(0.45, (0, 0, 0.2)), Key(0.6, (0, 0, 0.2)))),
    "place": StudyVerb(
        "place", 50,
        Motion((Key(0), Key(0.1), Key(0.35, (0.05, 0.02, 0.07)), Key(0.65, (0.15, 0.06, 0.07)),
                Key(0.92, (0.2, 0.07, 0)), Key(1, (0.2, 0.07, 0)))),
        heading_deg=30,
    ),
    "push": StudyVerb("push", 42, Motion((Key(0), Key(0.15), Key(0.85, (0, 0.16, 0)), Key(1, (0, 0.16, 0)))),
                      heading_deg=50),
    "turn": StudyVerb("turn", 44, _turned(70)),
    "pass": StudyVerb(
        "pass", 54,
        Motion((Key(0), Key(0.1), Key(0.42, (0, 0.1, 0.17)), Key(0.62, (0, 0.18, 0.17)), Key(0.93, (0, 0.25, 0)),
                Key(1, (0, 0.25, 0)))),
        heading_deg=20,
    ),
    "pour": StudyVerb(
        "pour", 76, _there_and_back(Key(0.26, _UP), _POURED, _POURED._replace(phase=0.7), Key(0.84, (0, 0, 0.14)))
    ),
    "drink": StudyVerb(
        "drink", 80,
        _there_and_back(Key(0.28, (0, -0.12, 0.22)), _DRUNK, _DRUNK._replace(phase=0.66), Key(0.8, (0, -0.12, 0.2))),
    ),
    "shake": StudyVerb(
        "shake", 72, _there_and_back(Key(0.22, _UP), Key(0.8, _UP), swing=Swing(0.22, 0.8, 4, (0, 0, 0.03)))
    ),
    "inspect": StudyVerb(
        "inspect", 84,
        _there_and_back(
            _SHOWN, _SHOWN._replace(phase=0.38, rotation_deg=(18, 0, 60)),
            _SHOWN._replace(phase=0.62, rotation_deg=(18, 0, -60)),
            _SHOWN._replace(phase=0.78),
        ),
    ),
    "hand over": StudyVerb(
        "offhand", 88,
        Motion((Key(0), Key(0.08), Key(0.32, (-0.05, 0, 0.15)), Key(0.68, (-0.05, 0.02, 0.15)),
                Key(0.92, (-0.14, 0.05, 0)), Key(1, (-0.14, 0.05, 0)))),
        heading_deg=20,
    ),
    "open": StudyVerb("open", 54, *_moving_lid(0, 1)),
    "close": StudyVerb("close", 50, *_moving_lid(1, 0)),
    "screw": StudyVerb("screw", 44, _turned(-70)),
    "unscrew": StudyVerb("unscrew", 44, _turned(70)),
}  # fmt: skip
HANDOVER = "hand over"
# Their sense of rotation is part of the verb, also for left hands. Each is the reverse of the other.
SCREWING = ("screw", "unscrew")

# The verbs of each object, for all hands. Two hands also hand over objects without a lid, except _TOO_SHORT ones.
_VERBS_OF = {
    "mug": "lift place push pass pour drink",
    "waterbottle": "unscrew screw pass pour drink shake",
    "teapot": "unscrew place push screw pour inspect",
    "wineglass": "lift place pass pour drink inspect",
    "fryingpan": "lift place push pour shake inspect",
    "cylinderlarge": "lift unscrew screw pass shake inspect",
    "cubelarge": "place push screw unscrew shake inspect",
    "flashlight": "place screw pass unscrew shake inspect",
    "box": "open close lift push inspect",
    "ketchup": "open close lift shake place",
    "mixer": "open close lift push place",
    "capsulemachine": "open close lift turn inspect",
    "waffleiron": "open close lift turn shake",
}

_TOO_SHORT = {"cubelarge"}

# Subjects and their numbers of clips. Test and validation subjects are those of the named splits of both datasets.
_SHARES = {
    "grab": {**dict.fromkeys(("s1", "s2", "s3", "s4", "s5", "s8"), 74), "s6": 24, "s7": 24, "s9": 72, "s10": 192},
    "arctic": {**dict.fromkeys(("s01", "s02", "s04", "s06", "s08", "s09"), 34), "s07": 24, "s05": 40, "s10": 96},
}
_SMALL_SHARES = {"grab": {"s1": 6, "s9": 2, "s10": 2}, "arctic": {"s01": 6, "s05": 2, "s10": 2}}
_NOT_TRAINED_ON = {"s9", "s05", "s10"}
_SMALL_OBJECTS = 2
_HANDS: tuple[HandType, ...] = ("right", "left", "both")


class StudyEntry(NamedTuple):
    """One clip of the plan."""

    subject: str
    object_index: int  # in STUDY_OBJECTS
    verb: str
    hand: HandType
    region: int  # index in ``choices``
    number: int  # counts the repetitions of verb and object by this subject from 1


def shares(dataset: str, size: StudySize) -> dict[str, int]:
    """Return the number of clips of each subject."""
    return (_SHARES if size == "study" else _SMALL_SHARES)[dataset]


def verbs_of(item: StudyObject, hand: HandType) -> list[str]:
    verbs = _VERBS_OF[item.spec.name].split()
    has_handover = hand == "both" and item.spec.lid is None and item.spec.name not in _TOO_SHORT
    return [*verbs, HANDOVER] if has_handover else verbs


def choices(item: StudyObject, verb: str, hand: HandType) -> list[tuple[Region, ...]]:
    """Return the choices of regions: one region, or for "hand over" the regions of the right and of the left hand."""
    if verb != HANDOVER:
        return [(region,) for region in item.regions(verb, 2 if hand == "both" else 1)]
    return [(a, b) for a in item.one for b in item.one if a != b and item.stands_alike(a, b)]


def study_plan(dataset: str, size: StudySize) -> list[StudyEntry]:
    """Plan all clips. A round has each verb with each object and hand once, in random order, with the next region.

    Subjects alternate.
    """
    amounts = shares(dataset, size)
    training_subjects = [name for name in amounts if name not in _NOT_TRAINED_ON]
    entries: list[StudyEntry] = []
    for part, names in enumerate((training_subjects, *([name] for name in amounts if name in _NOT_TRAINED_ON))):
        order = _alternating_subjects({name: amounts[name] for name in names})
        entries += _numbered(zip(order, _rounds(dataset, size, part), strict=False))
    return entries


def _rounds(dataset: str, size: StudySize, part: int) -> Iterator[tuple[int, str, HandType, int]]:
    """Yield (object index, verb, hand, region) without end."""
    objects = STUDY_OBJECTS[dataset][: _SMALL_OBJECTS if size == "study-small" else None]
    actions = [
        (number, verb, hand) for number, item in enumerate(objects) for hand in _HANDS for verb in verbs_of(item, hand)
    ]
    rng = np.random.default_rng([part, DATASET_IDS[dataset]])
    first = rng.integers(1000, size=len(actions))
    done = 0
    while True:
        for index in rng.permutation(len(actions)):
            number, verb, hand = actions[index]
            yield number, verb, hand, int(first[index] + done) % len(choices(objects[number], verb, hand))
        done += 1


def _alternating_subjects(amounts: dict[str, int]) -> list[str]:
    """Repeat each name as often as its amount, evenly distributed."""
    positions = [((repetition + 0.5) / count, name) for name, count in amounts.items() for repetition in range(count)]
    return [name for _, name in sorted(positions)]


def _numbered(pairs) -> Iterator[StudyEntry]:
    done: Counter[tuple] = Counter()
    for subject, (index, verb, hand, region) in pairs:
        done[subject, index, verb] += 1
        yield StudyEntry(
            subject=subject, object_index=index, verb=verb, hand=hand, region=region, number=done[subject, index, verb]
        )
