"""OakInk2's words: primitives of its programs as verbs, what the toolkit leaves unnamed, names of objects."""

UNKNOWN = "?(unk)"
# Primitive -> verb, where it is not the primitive itself with blanks for underscores: the object is named by itself.
_VERBS = {
    "brush_whiteboard": "brush with",
    "cap_the_pen": "cap",
    "close_book": "close",
    "close_gate": "close",
    "close_laptop_lid": "close",
    "flip_close_tooth_paste_cap": "close",
    "flip_open_tooth_paste_cap": "open",
    "heat_beaker": "heat",
    "heat_test_tube": "heat",
    "hold_test_tube": "hold",
    "ignite_alcohol_lamp": "light",
    "insert_lightbulb": "insert",
    "insert_pencil": "insert",
    "insert_usb": "insert",
    "open_book": "open",
    "open_gate": "open",
    "open_laptop_lid": "open",
    "place_asbestos_mesh": "place",
    "place_inside": "put in",
    "place_on_test_tube_rack": "place",
    "place_onto": "place",
    "place_test_tube_on_rack_with_holder": "place",
    "plug_in_power_plug": "plug in",
    "pour_in_lab": "pour",
    "press_button": "press",
    "pull_out_drawer": "pull out",
    "push_in_drawer": "push in",
    "put_flower_into_vase": "put in",
    "put_off_alcohol_lamp": "put out",
    "put_on_lid": "put on",
    "remove_from_test_tube_rack": "remove",
    "remove_lid": "remove",
    "remove_lightbulb": "remove",
    "remove_pencil": "remove",
    "remove_power_plug": "remove",
    "remove_test_tube": "remove",
    "remove_test_tube_from_rack_with_holder": "remove",
    "remove_the_pen_cap": "uncap",
    "remove_usb": "remove",
    "shake_lab_container": "shake",
    "sharpen_pencil": "sharpen",
    "shear_paper": "cut with",
    "squeeze_tooth_paste": "squeeze",
    "staple_paper_together": "staple with",
    "stir_experiment_substances": "stir",
    "take_outside": "take out",
    "trigger_lever": "press",
    "uncap_alcohol_lamp": "uncap",
    "use_gamecontroller": "use",
    "use_keyboard": "use",
    "use_mouse": "use",
    "write_on_paper": "write with",
    "write_on_whiteboard": "write with",
}


def verb_of(primitive: str) -> str | None:
    """The verb of a primitive, None where the makers could not name it."""
    if primitive == UNKNOWN or not primitive.strip(" _"):
        return None
    return _VERBS.get(primitive, " ".join(primitive.replace("_", " ").split()).lower())


def noun_of(name: str) -> str:
    """A name of ``obj_desc.json`` as a noun without article."""
    return " ".join(name.replace("_", " ").split()).lower()
