"""HOT3D's objects in words; nothing in the files says what is done with them."""

# Where the name of instance.json does not read as words.
NOUNS = {
    "aria_small": "smart glasses",
    "birdhouse_toy": "toy birdhouse",
    "bottle_bbq": "barbecue sauce bottle",
    "bottle_mustard": "mustard bottle",
    "bottle_ranch": "ranch dressing bottle",
    "can_parmesan": "parmesan can",
    "can_soup": "soup can",
    "can_tomato_sauce": "tomato sauce can",
    "carton_milk": "milk carton",
    "carton_oj": "orange juice carton",
    "dino_toy": "toy dinosaur",
    "dumbbell_5lb": "dumbbell",
    "dvd_remote": "remote control",
    "food_vegetables": "toy vegetables",
    "food_waffles": "toy waffles",
    "holder_black": "black holder",
    "holder_gray": "gray holder",
    "mug_patterned": "patterned mug",
    "mug_white": "white mug",
    "plate_bamboo": "bamboo plate",
    "spatula_red": "red spatula",
    "spoon_wooden": "wooden spoon",
}


def object_words(name: str) -> str:
    """An object of instance.json in words: ``mug_white`` -> "white mug", ``coffee_pot`` -> "coffee pot"."""
    return NOUNS.get(name, name.replace("_", " "))
