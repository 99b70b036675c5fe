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
            "verb_input": True,
        },
        "training": {**BUDGET, "keep_best": True},
    },
    "diffusion": {
        "network": {
            "transformer": TRANSFORMER,
            "contact_input": "tokens",
            "verb_input": True,
            "motion": {"knot_frames": 4},
            "signal_scale": 1.0,
        },
        "training": BUDGET,
    },
    "refiner": {
        "network": {
            "transformer": TRANSFORMER,
            "output": "residual",
        },
        "training": BUDGET,
    },
}


# Either of BimArt's networks.
BIMART = {
    "network": {
        "features": {
            "basis": {"count": 8},
            "keypoints": 20,
            "window_frames": 16,
            "state": "local",
            "max_distance_m": 0.2,
        },
        "transformer": {"width": 16, "layers": 1, "heads": 2, "feed_forward": 16, "norm_first": True},
        "encoder": [16],
        "condition_on_hands": True,
        "diffusion_steps": 1000,
    },
    "training": {"steps": 4, "batch": 2, "learning_rate": 0.001, "validate_every": 2},
}

# Preset `paper` with small layers.
SMALL_TRANSFORMER = {"width": 32, "layers": 1, "heads": 2, "feed_forward": 32}
PAPER = {
    "contact": {"network": {"point_net": POINT_NET, "decoder_widths": [32, 16, 8]}, "training": BUDGET},
    "length": {"network": {"width": 16}, "training": BUDGET},
    "diffusion": {"network": {"transformer": SMALL_TRANSFORMER}, "training": BUDGET},
    "refiner": {
        "network": {"transformer": SMALL_TRANSFORMER},
        "training": BUDGET,
    },
}


def train(name: str, root: Path, out: Path, device: str = "cpu", params: dict = PARAMS) -> Path:
    network = load_network(name)
    needed = {load_network(other): out / other for other in network.needs}
    provenance = lambda facts: {"model": facts["model"]}  # noqa: E731
    return train_network(network, root, out / name, params[name], needed=needed, provenance=provenance, device=device)


# Sections of families with which sampling takes a moment.
FAST = {"text2hoi": {"sampler": {"steps": 2}}}
