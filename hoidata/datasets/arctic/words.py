"""ARCTIC's objects in words, the verbs of Text2HOI's descriptions, and the pairs that Text2HOI leaves out."""

EXCLUDED = {("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")}  # as Text2HOI does
OBJECT_WORDS = {
    "capsulemachine": "capsule machine",
    "espressomachine": "espresso machine",
    "waffleiron": "waffle iron",
}
OBJECTS = ("box", "capsulemachine", "espressomachine", "ketchup", "laptop", "microwave", "mixer", "notebook", "phone",
           "scissors", "waffleiron")  # fmt: skip
VERBS = ("close", "cut", "grasp", "lift", "open", "operate", "place", "point", "shake", "sprinkle", "type")


def object_words(name: str) -> str:
    """ARCTIC's joined object name in words; other names stay."""
    return OBJECT_WORDS.get(name, name)


# Every verb with every object but for those that only some objects can be used for.
_ONLY = {"cut": ("scissors",), "sprinkle": ("ketchup",), "type": ("laptop", "phone")}
PAIRS = tuple(
    (verb, object_words(name))
    for verb in VERBS
    for name in OBJECTS
    if (verb, name) not in EXCLUDED and name in _ONLY.get(verb, OBJECTS)
)
