"""H2O's objects by class id and actions by label, as the dataset's README lists them."""

OBJECTS = ("", "book", "espresso", "lotion", "spray", "milk", "cocoa", "chips", "cappuccino")  # by class id
_SHELF = OBJECTS[1:]
ACTIONS: tuple[tuple[str, str], ...] = (  # (verb, object) by action label; 0 is background
    ("", ""),
    *(("grab", noun) for noun in _SHELF),
    *(("place", noun) for noun in _SHELF),
    *(("open", noun) for noun in ("lotion", "milk", "chips")),
    *(("close", noun) for noun in ("lotion", "milk", "chips")),
    ("pour", "milk"),
    *(("take out", noun) for noun in ("espresso", "cocoa", "chips", "cappuccino")),
    *(("put in", noun) for noun in ("espresso", "cocoa", "cappuccino")),
    *(("apply", noun) for noun in ("lotion", "spray")),
    *(("read", noun) for noun in ("book", "espresso")),
    ("spray", "spray"),
    ("squeeze", "lotion"),
)
PAIRS = ACTIONS[1:]
