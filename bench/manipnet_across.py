"""Fingers by the model of one dataset for clips of another: what carries over, in one table.

``python -m bench manipnet-across``. HOIDATA_BENCH_PROJECTS: folders of projects with trained networks
(``checkpoints/<profile>/<dataset>/manipnet``) and their data, divided by colons; this one by default. At most seven
test clips of each dataset, post-processed, joints in the wrist frame.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from bench.harness import show
from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.hands import HandPair
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import FILE_NAME, load_checkpoint
from models.manipnet.diagnostics import recorded_hands
from models.manipnet.family import Fingers
from models.manipnet.lookups import joint_errors_m
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor
from models.manipnet.training import MANIPNET

MOST_CLIPS = 7


class Trained(NamedTuple):
    """A dataset of a project, its test clips and where its network is."""

    name: str
    pair: HandPair
    clips: list[ClipSample]
    checkpoint: Path


def main() -> None:
    torch.set_num_threads(1)
    projects = [Path(folder) for folder in os.environ.get("HOIDATA_BENCH_PROJECTS", ".").split(":")]
    found = [one for project in projects for one in trained_in(project)]
    if not found:
        print("no network for fingers: name a dataset under family_datasets.manipnet in params.yaml, then dvc repro")
        return
    rows = []
    for model in found:
        checkpoint = load_checkpoint(model.checkpoint, MANIPNET)
        assert isinstance(checkpoint.network, ManipNet)
        cells = [f"{error_mm(Fingers(checkpoint, one.pair, Predictor(checkpoint.network)), one):.1f}" for one in found]
        rows.append([model.name, *cells])
    show("Joints, mm, of test clips of (across) by the model of (down)", ["", *(one.name for one in found)], rows)


def trained_in(project: Path) -> list[Trained]:
    """Every dataset of a project that has a network and test clips."""
    found = []
    for path in sorted(project.glob(f"checkpoints/*/*/{MANIPNET.name}/{FILE_NAME}")):
        profile, dataset = path.parts[-4:-2]
        annotated = load_annotated(project / "data" / profile / dataset)
        if clips := list(HoiDataset(annotated, "test", crop="start"))[:MOST_CLIPS]:
            found.append(Trained(f"{profile}/{dataset}", annotated.store.hand_pair(), clips, path.parent))
    return found


def error_mm(fingers: Fingers, one: Trained) -> float:
    """Mean joint error over all frames of the hands that take part."""
    errors = []
    for clip in one.clips:
        made = fingers.follow(clip)
        for hand in recorded_hands(clip, one.pair):
            errors.append(joint_errors_m(hand.hand, made[hand.side][hand.used], hand.fingers[hand.used]).mean(axis=1))
    return 1000 * float(np.concatenate(errors).mean())
