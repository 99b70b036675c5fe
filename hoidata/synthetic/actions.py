"""The actions of the embedded corpora: verb, object, grasp and length.

All pairs of verb and object occur in the real label tables. Each pair has one hand type and one grasped region, so that
the sentence determines both. Objects have several verbs, so that the object alone does not.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from hoidata.synthetic.grasps import Approach, GraspSpec
from hoidata.synthetic.paths import MOTIONS, Motion


@dataclass(frozen=True)
class Action:
    """A verb with an object, the grasp and the motion."""

    verb: str
    object_name: str  # as in the source
    grasp: GraspSpec
    motion_name: str = ""  # key of MOTIONS; by default the verb
    intent: str = ""  # as in the files of GRAB

    @property
    def motion(self) -> Motion:
        return MOTIONS[self.motion_name or self.verb]


RIGHT = GraspSpec((("right", Approach((0.75, -0.35, 0.45))),))
LEFT = GraspSpec((("left", Approach((-0.75, -0.35, 0.45))),))
SIDES = GraspSpec(
    (
        ("left", Approach((-1, -0.1, 0.1), 0.22, blend=(0, 0.6))),
        ("right", Approach((1, -0.1, 0.1), 0.22, blend=(0, 0.6))),
    )
)


def _body_and_lid(body_m: tuple[float, float, float], lid_m: tuple[float, float, float]) -> GraspSpec:
    """Left hand around the body, right hand on the lid of a rigid container."""
    left = Approach((-1, -0.2, 0.1), 0.3, body_m, (0, 0.6))
    return GraspSpec((("left", left), ("right", Approach((0.7, -0.2, 0.7), 0.35, lid_m, (0, 0.8)))))


def _base_and_lid(angles_rad: tuple[float, ...]) -> GraspSpec:
    """Left hand on the base, right hand on the lid; the hands arrive at the first hinge angle."""
    base = Approach((-1, -0.3, 0.0), 0.45, blend=(0, 0.8), part=0)
    return GraspSpec(
        (("left", base), ("right", Approach((1, -0.4, 0.4), 0.45, blend=(0, 0.8), part=1))), angles_rad[0], angles_rad
    )


OPENING = _base_and_lid((0.4, 0.62, 0.85))
CLOSING = _base_and_lid((0.85, 0.62, 0.4))
MUG_HANDLE = GraspSpec((("right", Approach((1, -0.35, 0.2), 0.35, (0.079, 0, 0.045), (0.0, 0.9))),))
TEAPOT_HANDLE = GraspSpec((("right", Approach((0.5, -0.4, 0.9), 0.3, (0.125, 0, 0.08), (0, 0.8))),))
HAMMER_HANDLE = GraspSpec((("right", Approach((0.3, -0.4, 0.9), 0.3, (0.05, 0, 0.02), (0, 0.8))),))
STEM_LEFT = GraspSpec((("left", Approach((-1, -0.35, 0.2), 0.3, (0, 0, 0.13))),))
STEM_RIGHT = GraspSpec((("right", Approach((1, -0.35, 0.2), 0.3, (0, 0, 0.13))),))

H2O_ACTIONS = (
    Action("grab", "espresso", RIGHT),
    Action("put in", "cappuccino", LEFT),
    Action("read", "book", SIDES),
    Action("pour", "milk", RIGHT),
    Action("grab", "milk", LEFT),
    Action("place", "cappuccino", RIGHT),
    Action("place", "cocoa", LEFT),
    Action("take out", "espresso", LEFT),
    Action("take out", "chips", RIGHT),
    Action("put in", "cocoa", RIGHT),
    Action("open", "lotion", _body_and_lid((0, 0, 0.07), (0, 0, 0.165)), "open rigid"),
    Action("open", "milk", _body_and_lid((0, 0, 0.08), (0, 0, 0.17)), "open rigid"),
    Action("close", "chips", _body_and_lid((0, 0, 0.07), (0, 0, 0.18)), "close rigid"),
    Action("grab", "book", SIDES),
    Action("spray", "spray", RIGHT),
    Action("squeeze", "lotion", RIGHT),
    Action("apply", "lotion", LEFT),
    Action("read", "espresso", RIGHT),
)

GRAB_ACTIONS = (
    Action("lift", "cubelarge", RIGHT, intent="lift"),
    Action("eat", "apple", LEFT, intent="eat"),
    Action("hand over", "cylinderlarge", SIDES, intent="offhand"),
    Action("drink", "mug", MUG_HANDLE, intent="drink"),
    Action("lift", "spheremedium", LEFT, intent="lift"),
    Action("lift", "toruslarge", RIGHT, intent="lift"),
    Action("pass", "cylindermedium", LEFT, intent="pass"),
    Action("pass", "waterbottle", RIGHT, intent="pass"),
    Action("pass", "cubemedium", RIGHT, intent="pass"),
    Action("hand over", "spherelarge", SIDES, intent="offhand"),
    Action("inspect", "cubelarge", SIDES, intent="inspect"),
    Action("inspect", "cylinderlarge", LEFT, intent="inspect"),
    Action("inspect", "spheremedium", RIGHT, intent="inspect"),
    Action("drink", "wineglass", STEM_LEFT, intent="drink"),
    Action("toast", "wineglass", STEM_RIGHT, intent="toast"),
    Action("pour", "teapot", TEAPOT_HANDLE, intent="pour"),
    Action("pour", "waterbottle", LEFT, intent="pour"),
    Action("shake", "waterbottle", SIDES, intent="shake"),
    Action("use", "hammer", HAMMER_HANDLE, intent="use"),
)

ARCTIC_ACTIONS = (
    Action("open", "laptop", OPENING),
    Action("shake", "ketchup", RIGHT),
    Action("grasp", "ketchup", LEFT),
    Action("close", "box", CLOSING),
    Action("lift", "laptop", SIDES),
    Action("grasp", "box", SIDES),
    Action("lift", "mixer", RIGHT),
    Action("lift", "waffleiron", SIDES),
    Action("place", "notebook", SIDES),
    Action("place", "phone", LEFT),
    Action("place", "ketchup", RIGHT),
    Action("open", "capsulemachine", OPENING),
    Action("open", "microwave", OPENING),
    Action("close", "laptop", CLOSING),
    Action("close", "waffleiron", CLOSING),
    Action("sprinkle", "ketchup", LEFT),
    Action("type", "phone", RIGHT),
    Action("operate", "microwave", _base_and_lid((0.4, 0.62, 0.85))),
)

ACTIONS = {"h2o": H2O_ACTIONS, "grab": GRAB_ACTIONS, "arctic": ARCTIC_ACTIONS}

# Mean length of a clip in 30 fps frames; lengths vary about it with LENGTH_DEVIATION.
MEAN_LENGTH = {
    "h2o": {
        "grab": 46, "place": 56, "put in": 66, "take out": 76, "close": 84, "open": 92, "spray": 100, "apply": 108,
        "squeeze": 116, "pour": 124, "read": 134,
    },
    "grab": {
        "lift": 46, "pass": 58, "toast": 70, "shake": 80, "hand over": 90, "eat": 98, "use": 104, "pour": 112,
        "drink": 122, "inspect": 134,
    },
    "arctic": {
        "grasp": 45, "place": 56, "lift": 66, "shake": 78, "close": 88, "open": 100, "sprinkle": 112, "type": 122,
        "operate": 134,
    },
}  # fmt: skip
LENGTH_DEVIATION = 16.0
SHORTEST_CLIP, LONGEST_CLIP = 34, 148

H2O_VERB_IDS = {
    "grab": 1, "place": 2, "open": 3, "close": 4, "pour": 5, "take out": 6, "put in": 7, "apply": 8, "read": 9,
    "spray": 10, "squeeze": 11,
}  # fmt: skip
H2O_OBJECT_IDS = {
    "book": 1, "espresso": 2, "lotion": 3, "spray": 4, "milk": 5, "cocoa": 6, "chips": 7, "cappuccino": 8,
}  # fmt: skip
_H2O_PAIRS = (
    *(("grab", name) for name in H2O_OBJECT_IDS),
    *(("place", name) for name in H2O_OBJECT_IDS),
    ("open", "lotion"), ("open", "milk"), ("open", "chips"), ("close", "lotion"), ("close", "milk"), ("close", "chips"),
    ("pour", "milk"), ("take out", "espresso"), ("take out", "cocoa"), ("take out", "chips"),
    ("take out", "cappuccino"), ("put in", "espresso"), ("put in", "cocoa"), ("put in", "cappuccino"),
    ("apply", "lotion"), ("apply", "spray"), ("read", "book"), ("read", "espresso"), ("spray", "spray"),
    ("squeeze", "lotion"),
)  # fmt: skip
H2O_ACTION_IDS = {pair: index for index, pair in enumerate(_H2O_PAIRS, 1)}

Size = Literal["full", "small"]
DATASET_IDS = {"h2o": 1, "grab": 2, "arctic": 3}


class Entry(NamedTuple):
    """One sequence of the plan."""

    subject: str
    action: int  # index in ACTIONS[dataset]
    number: int  # counts the repetitions by this subject from 1


class Cast(NamedTuple):
    """Subjects of the training, validation and test splits, and the number of actions of each split."""

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
    """Plan all actions of a corpus. All actions of validation and test also occur in training."""
    cast = CASTS[dataset][size]
    n_actions = min(_ACTIONS_OF[size], len(ACTIONS[dataset]))
    if cast.counts[0] < n_actions:
        raise ValueError(f"{dataset} {size}: {cast.counts[0]} training actions cannot show {n_actions} pairs")
    entries: list[Entry] = []
    for split, (names, count) in enumerate(zip(cast[:3], cast.counts, strict=True)):
        for index in range(count):
            # A different offset per split, so that short splits do not start with the same actions.
            action = (index + 5 * split) % n_actions
            subject = names[(index + index // n_actions) % len(names)]
            done = sum(entry.subject == subject and entry.action == action for entry in entries)
            entries.append(Entry(subject, action, done + 1))
    return entries
