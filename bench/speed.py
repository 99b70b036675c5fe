"""Text2HOI's Table S2: time for one motion of 150 frames and both hands, all methods at full size in one run.

``python -m bench speed``. HOIDATA_BENCH_OUT: the project folder (.hoidata/speed). Networks are trained for one step,
because time does not depend on the weights. Diffusion takes 20 steps; the time of 1,000 is scaled. The baseline is the
nearest training clip.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bench.harness import medians, show
from bench.project import open_project, reproduce
from hoidata.batches.dataset import MAX_FRAMES, HoiDataset
from hoidata.batches.requests import Request
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import load_annotated
from models.common.family import Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.repeatable import chosen_device
from models.registry import load_family
from models.text2hoi.family import load_text2hoi

STEPS, PAPER_STEPS, RUNS = 20, 1000, 3
NETWORKS = ("contact", "length", "diffusion", "refiner", "mdm", "imos", "t2m-movement", "t2m", "t2m-length")
SETTINGS = {
    "profile": "embedded",
    "datasets": ["grab"],
    # Validation of full networks takes minutes.
    "split": {"grab": {"by": "subject", "train": "rest", "validation": [], "test": ["s10"]}},
    "family_datasets": {"mdm": ["grab"], "imos": ["grab"], "t2m": ["grab"]},
    "train": {
        "preset": "paper",
        "size": "full",
        "full": {name: {"training": {"steps": 1, "batch": 2, "validate_every": 1}} for name in NETWORKS},
    },
}
TRAINED = (
    "models/text2hoi/dvc.yaml:train-refiner@embedded-grab",
    "models/mdm/dvc.yaml:train@embedded-grab",
    "models/imos/dvc.yaml:train@embedded-grab",
    "models/t2m/dvc.yaml:train-generator@embedded-grab",
)
SAMPLER = {"sampler": {"kind": "ddim", "steps": STEPS}}
# Title, family, and whether its time is that of denoising steps.
METHODS = (
    ("nearest sentence", "nearest-clip", False),
    ("T2M, given length", "t2m-given-length", False),
    ("MDM", "mdm", True),
    ("IMoS", "imos", False),
    ("Text2HOI, unrefined", "text2hoi-coarse", True),
    ("Text2HOI", "text2hoi", False),  # as unrefined, then the refiner once
)


def main() -> None:
    project = Path(os.environ.get("HOIDATA_BENCH_OUT", ".hoidata/speed")).resolve()
    open_project(project, SETTINGS)
    reproduce(project, *TRAINED)
    hands, device = load_embedded_hands(), torch.device(chosen_device("auto"))
    annotated = load_annotated(project / "data/embedded/grab", hands)
    settings = {"mdm": SAMPLER, "text2hoi": SAMPLER}
    sources = Sources(annotated, project / "checkpoints/embedded/grab", hands, device, settings)
    clip = next(iter(HoiDataset(annotated, "test", crop="start")))
    request = replace(
        requests_for(clip, PredictionConfig(samples=1))[0], n_frames=MAX_FRAMES, active_hands=np.ones(2, bool)
    )
    networks = load_text2hoi(sources)
    calls: dict[str, Callable[[], object]] = {"Text2HOI, contact map": lambda: networks.contact_maps([request])}
    calls |= {title: one_motion(family, sources, request) for title, family, _ in METHODS}
    by_denoising = {title for title, _, is_denoising in METHODS if is_denoising}
    times = medians(calls, RUNS)
    rows = [
        [
            title,
            f"{timing.median:.2f}",
            f"{timing.processor:.2f}",
            f"{timing.processor * PAPER_STEPS / STEPS:.0f}" if title in by_denoising else "",
        ]
        for title, timing in times.items()
    ]
    columns = ["method", "wall s", "processor s", f"{PAPER_STEPS:,} steps, scaled"]
    show(f"One motion of {MAX_FRAMES} frames and both hands, full size, on {device.type}", columns, rows)


def one_motion(family: str, sources: Sources, request: Request) -> Callable[[], object]:
    """A call that samples the motion; its answer must be a motion."""
    sampler = load_family(family).load(sources)

    def call() -> object:
        motion = sampler.sample([request])[0]
        assert getattr(motion, "n_frames", 0), motion
        return motion

    return call
