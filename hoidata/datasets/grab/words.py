"""GRAB's 29 intents and the names of its objects in words (Taheri et al. 2020; the renamed ones as in Text2HOI)."""

import re

# Verb by ``motion_intent``.
INTENTS = {
    **{word: word for word in ("browse", "brush", "call", "chop", "clean", "cook", "drink", "eat", "fly", "inspect")},
    **{word: word for word in ("lift", "open", "pass", "peel", "play", "pour", "screw", "see", "set", "shake")},
    **{word: word for word in ("squeeze", "stamp", "staple", "toast", "use", "wear")},
    "offhand": "hand over",
    "switchON": "switch on",
    "takepicture": "take a picture with",
}
_SHAPES, _SIZES = ("cube", "cylinder", "pyramid", "sphere", "torus"), ("small", "medium", "large")
# The 51 manipulated objects; sizes of the plain shapes are part of their words.
OBJECTS = {
    **{shape + size: f"{size} {shape}" for shape in _SHAPES for size in _SIZES},
    **{name: name for name in ("airplane", "apple", "banana", "binoculars", "bowl", "camera", "cup", "doorknob")},
    **{name: name for name in ("duck", "elephant", "eyeglasses", "flashlight", "flute", "hammer", "hand")},
    **{name: name for name in ("headphones", "knife", "mouse", "mug", "phone", "scissors", "stamp", "stapler")},
    **{name: name for name in ("teapot", "toothbrush", "toothpaste", "train", "watch")},
    "alarmclock": "alarm clock",
    "fryingpan": "frying pan",
    "gamecontroller": "game controller",
    "lightbulb": "light bulb",
    "piggybank": "piggy bank",
    "stanfordbunny": "Stanford bunny",
    "waterbottle": "water bottle",
    "wineglass": "wine glass",
}
# Intents recorded with an object beyond lift, pass and offhand, which GRAB recorded with all but those of ``_NEVER``.
_RECORDED = {
    **{shape + size: "inspect" for shape in _SHAPES for size in _SIZES},
    **{name: "inspect" for name in ("duck", "elephant", "stanfordbunny")},
    **{name: "use" for name in ("doorknob", "hammer", "headphones", "mouse", "piggybank", "scissors")},
    **{name: "play" for name in ("flute", "gamecontroller", "train")},
    **{"airplane": "fly", "alarmclock": "see", "apple": "eat", "banana": "eat peel", "binoculars": "see"},
    **{"bowl": "drink", "camera": "browse takepicture", "cup": "drink pour", "eyeglasses": "clean wear"},
    **{"flashlight": "switchON", "fryingpan": "cook", "hand": "inspect shake", "knife": "chop peel"},
    **{"lightbulb": "screw", "mug": "drink toast", "phone": "call", "stamp": "stamp", "stapler": "staple"},
    **{"teapot": "pour", "toothbrush": "brush", "toothpaste": "squeeze", "watch": "set"},
    **{"waterbottle": "drink open pour shake", "wineglass": "drink toast"},
}
_NEVER = {
    "lift": ("lightbulb", "pyramidsmall", "scissors"),
    "pass": ("doorknob",),
    "offhand": (
        "doorknob", "hammer", "knife", "lightbulb", "pyramidsmall", "teapot", "toothbrush", "toothpaste", "toruslarge",
    ),
}  # fmt: skip
# The 202 pairs of verb and object that GRAB has, in words.
PAIRS = tuple(
    (INTENTS[intent], words)
    for name, words in OBJECTS.items()
    for intent in (*_RECORDED[name].split(), *(general for general, names in _NEVER.items() if name not in names))
)
# Further meshes in GRAB's folder of objects.
OTHER_MESHES = {
    "coffeemug": "coffee mug",
    "cubemiddle": "middle cube",
    "rubberduck": "rubber duck",
    "table": "table",
    "wristwatch": "wristwatch",
}
_BEFORE_CAPITAL = re.compile(r"(?<=[a-z])(?=[A-Z])|[_\s-]+")


def verb_words(intent: str) -> str | None:
    """The verb of an intent. An unknown intent is split at capitals, ``_``, ``-`` and blanks; "" gives None."""
    return INTENTS.get(intent) or " ".join(_BEFORE_CAPITAL.split(intent)).strip().lower() or None


def object_words(name: str) -> str:
    """GRAB's joined object name in words, size first: ``cubelarge`` is "large cube". Unknown names are unchanged."""
    return OBJECTS.get(name) or OTHER_MESHES.get(name, name)
