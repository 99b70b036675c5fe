"""On which device networks run: the setting ``device`` of params.yaml as torch's name for it."""

import torch

from hoidata.errors import BadInput, MissingResource

DEVICES = ("auto", "cpu", "cuda")


def chosen_device(setting: str) -> str:
    """``cuda`` or ``cpu``: auto takes a GPU where torch finds one.

    Raises BadInput for another word, and MissingResource where cuda is asked for and there is none.
    """
    if setting not in DEVICES:
        raise BadInput("params.yaml: device", " or ".join(DEVICES), repr(setting), "correct it")
    if setting == "cuda" and not torch.cuda.is_available():
        raise MissingResource("params.yaml: device is cuda, and torch finds no GPU; set it to auto or cpu")
    return "cuda" if setting != "cpu" and torch.cuda.is_available() else "cpu"
