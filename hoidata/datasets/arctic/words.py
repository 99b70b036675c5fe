"""ARCTIC's objects in words, and the pairs of verb and object that Text2HOI leaves out."""

EXCLUDED = {("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")}  # as Text2HOI does
OBJECT_WORDS = {
    "capsulemachine": "capsule machine",
    "espressomachine": "espresso machine",
    "waffleiron": "waffle iron",
}


def object_words(name: str) -> str:
    """ARCTIC's joined object name in words; other names stay."""
    return OBJECT_WORDS.get(name, name)
