"""Which device a run computes on."""

import torch

from hoidata.errors import BadInput

SETTINGS = ("auto", "cpu", "cuda")


def chosen_device(setting: str) -> str:
    """Torch's name of the device: ``auto`` takes a GPU where there is one. Raises BadInput for a GPU that is absent."""
    if setting not in SETTINGS:
        raise BadInput("params.yaml: device", f"one of {', '.join(SETTINGS)}", setting, "correct it")
    present = torch.cuda.is_available()
    if setting == "cuda" and not present:
        raise BadInput("params.yaml: device", "a GPU that torch can use", "none", "set device to auto or cpu")
    return "cuda" if present and setting != "cpu" else "cpu"
