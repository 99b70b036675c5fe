"""HOI4D's words: categories by their number, events of the action files, phrases of the makers' task table."""

from typing import NamedTuple

from hoidata.clips.clip import HandType


class Category(NamedTuple):
    """folder: of its meshes. words: the noun without article. hinged: its meshes lie below ``articulated``."""

    folder: str
    words: str
    hinged: bool


CATEGORIES = {
    "C1": Category("ToyCar", "toy car", False),
    "C2": Category("Mug", "mug", False),
    "C3": Category("Laptop", "laptop", True),
    "C4": Category("StorageFurniture", "storage cabinet", True),
    "C5": Category("Bottle", "bottle", False),
    "C6": Category("Safe", "safe", True),
    "C7": Category("Bowl", "bowl", False),
    "C8": Category("Bucket", "bucket", True),
    "C9": Category("Scissors", "scissors", True),
    "C11": Category("Pliers", "pliers", True),
    "C12": Category("Kettle", "kettle", False),
    "C13": Category("Knife", "knife", False),
    "C14": Category("TrashCan", "trash can", True),
    "C17": Category("Lamp", "lamp", True),
    "C18": Category("Stapler", "stapler", True),
    "C20": Category("Chair", "chair", False),
}
# Event of color.json in lower case -> verb and the hand it names; None: nothing is done to the object.
EVENTS: dict[str, tuple[str, HandType | None] | None] = {
    **dict.fromkeys(("rest", "reachout", "stop", "go", "lookaround")),
    "grasp": ("grasp", None),
    "pickup": ("pick up", None),
    "putdown": ("put down", None),
    "carry": ("carry", None),
    "carrywithbothhands": ("carry", "both"),
    "open": ("open", None),
    "close": ("close", None),
    "push": ("push", None),
    "pull": ("pull", None),
    "press": ("press", None),
    "turn&on&the&switch": ("turn on", None),
    "cut": ("cut", None),
    "paper-cut": ("cut", None),
    "binding": ("bind", None),
    "dump": ("dump", None),
}
# Of the makers' table what is known here, by category and task; a whole recording of another task has no verb.
TASKS = {("C6", "T1"): "open and close", ("C9", "T2"): "cut", ("C11", "T4"): "clamp"}
