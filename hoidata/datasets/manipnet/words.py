"""The words of ManipNet's objects, from their file names."""

import re

SIZES = {"small": "small", "med": "medium", "large": "large"}
NOUNS = {
    "cyl": "cylinder",
    "hemi": "hemisphere",
    "tetra": "tetrahedron",
    "tri prism": "triangular prism",
    "wineglass": "wine glass",
}


def object_words(name: str) -> str:
    """A released object's file name in words: ``cyl_med`` -> "medium cylinder", ``teapot2`` -> "teapot"."""
    words = [re.sub(r"\d+$", "", word) for word in name.split("_")]
    sizes = [SIZES[word] for word in words if word in SIZES]
    noun = " ".join(word for word in words if word not in SIZES and word not in ("body", "old", "simplified"))
    return " ".join([*sizes, NOUNS.get(noun, noun)])
