"""The smallest networks that still have every part, trained on the toy dataset in seconds."""

from pathlib import Path

from models.common.training import train_network
from models.registry import load_network

POINT_NET = {"widths": [16, 32, 64], "heads": [32, 16], "align": False}
TRANSFORMER = {
    "width": 32, "layers": 1, "heads": 2, "feed_forward": 64, "dropout": 0.1, "norm_first": True, "frames_per_token": 5,
}  # fmt: skip
BUDGET = {"steps": 2, "batch": 2, "learning_rate": 0.001, "validate_every": 1, "ema_decay": 0.5}
PARAMS = {
    "contact": {
        "network": {"point_net": POINT_NET, "decoder_widths": [32, 16, 8], "sampled_from": "anchor_points"},
        "training": BUDGET,
    },
    "length": {
        "network": {
            "width": 16,
            "sampled_from": "gaussian",
            "text_input": "verb_probabilities",
            "condition_on_hands_and_length": True,
        },
        "training": {**BUDGET, "keep_best": True},
    },
    "diffusion": {
        "network": {
            "transformer": TRANSFORMER,
            "contact_input": "tokens",
            "text_input": "verb_probabilities",
            "motion": {"knot_frames": 4},
            "normalised": True,
            "condition_on_hands_and_length": True,
            "object_dropout": 0.5,
            "scale_input": False,
        },
        "training": BUDGET,
    },
    "refiner": {
        "network": {
            "transformer": TRANSFORMER,
            "contact_map": False,
            "view": "object",
            "surface_input": True,
            "output": "residual",
        },
        "training": BUDGET,
        "loss": {"coarse_motions": "half_sampled", "samples": 2, "sampler_steps": 2, "field_resolution": 16},
    },
}


def train(name: str, root: Path, out: Path, device: str = "cpu") -> Path:
    network = load_network(name)
    needed = {load_network(other): out / other for other in network.needs}
    provenance = lambda facts: {"model": facts["model"]}  # noqa: E731
    return train_network(network, root, out / name, PARAMS[name], needed=needed, provenance=provenance, device=device)


# Sections of families with which sampling takes a moment.
FAST = {"text2hoi": {"sampler": {"steps": 2}, "field_resolution": 16}}
