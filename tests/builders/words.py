"""ARCTIC's verbs and objects as Text2HOI words them (supplement 6)."""

ARCTIC_VERBS = ("close", "cut", "grasp", "lift", "open", "operate", "place", "point", "shake", "sprinkle", "type")
ARCTIC_OBJECTS = (
    "box", "capsule machine", "espresso machine", "ketchup", "laptop", "microwave", "mixer", "notebook", "phone",
    "scissors", "waffle iron",
)  # fmt: skip
