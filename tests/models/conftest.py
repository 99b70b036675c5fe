"""A small annotated dataset for the models: hands that come to an object, carry it, and let go."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from hoidata.annotation.stage import annotate_store
from hoidata.batches.dataset import ClipBatch, HoiDataset, collate
from hoidata.clips.clip import Clip, HandTrack, ObjectTrack
from hoidata.contact.stage import contact_store
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.splits import split_store
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from tests.models.toy import PARAMS, train

torch.set_num_threads(1)
GRASP_HEIGHT_M = 0.01


def box_model() -> ObjectModel:
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    return ObjectModel("box", box.vertices, box.faces, np.zeros(8, np.uint8))


def folder_model() -> ObjectModel:
    """Two flat boxes side by side; the second turns about the edge between them."""
    base = trimesh.creation.box((0.1, 0.1, 0.02))
    vertices = np.concatenate([base.vertices - np.array([0.05, 0, 0]), base.vertices + np.array([0.05, 0, 0])])
    faces = np.concatenate([base.faces, base.faces + 8])
    hinge = Hinge(np.array([0.0, 1.0, 0.0]), np.zeros(3))
    return ObjectModel("notebook", vertices, faces, (np.arange(16) >= 8).astype(np.uint8), hinge)


@dataclass(frozen=True)
class Plan:
    subject: str
    verb: str
    model: ObjectModel
    left: bool
    right: bool
    frames: int


PLANS = (
    Plan("s1", "lift", box_model(), True, False, 24),
    Plan("s1", "pass", box_model(), False, True, 32),
    Plan("s1", "open", folder_model(), True, True, 28),
    Plan("s2", "lift", box_model(), False, True, 25),
    Plan("s2", "open", folder_model(), True, True, 27),
    Plan("s3", "lift", box_model(), True, False, 24),
    Plan("s3", "pass", box_model(), False, True, 33),
)


def make_clip(number: int, plan: Plan) -> Clip:
    """Acting hands rest above the object in the middle of the clip; others stay a metre away."""
    frames = plan.frames
    away = np.abs(np.linspace(-1, 1, frames)) * 0.1
    path = np.zeros((frames, 3))
    path[:, 2 if plan.verb == "lift" else 0] = np.linspace(0, 0.2, frames)
    start = np.array([0.3, -0.2, 0.9])
    top = float(plan.model.vertices_m[:, 2].max()) + GRASP_HEIGHT_M
    hands = {}
    for side, active_hands, shift in (("left", plan.left, -0.04), ("right", plan.right, 0.04)):
        wrist = path + start + np.array([shift, 0, top]) + away[:, None] * np.array([0, 0, 1.0])
        orient = np.tile(np.array([0.1 * number, 0.2, 0.0]), (frames, 1))
        hands[side] = HandTrack(
            (wrist if active_hands else wrist + 1).astype(np.float32),
            orient.astype(np.float32),
            np.full((frames, 45), 0.05, np.float32),
            np.full((1, 10), 0.3, np.float32),
            np.ones(frames, bool),
        )
    hinge = np.linspace(0, 0.6, frames).astype(np.float32) if plan.model.is_articulated else None
    turn = np.zeros((frames, 3), np.float32)
    turn[:, 2] = np.linspace(0, 0.5, frames)
    track = ObjectTrack(plan.model, turn, (path + start).astype(np.float32), hinge)
    return Clip(
        f"toy/{plan.subject}/{number}", "toy", plan.subject, f"{number}", hands, track,
        np.arange(frames, dtype=np.int32), np.array([0.0, 0.0, -1.0]), plan.verb, plan.model.name, synthetic=True,
    )  # fmt: skip


def write_annotated(root: Path, clips: list[Clip]) -> Path:
    write_store(root / "clips", clips, generated_info("toy"))
    annotate_store(root / "clips", root / "annotation", encoder="hash")
    contact_store(root / "clips", root / "contact")
    rule = {"by": "subject", "train": ["s1"], "validation": ["s2"], "test": ["s3"]}
    split_store(root / "clips", root / "annotation", root / "splits", rule)
    return root


@pytest.fixture(scope="session")
def annotated_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = [make_clip(number, plan) for number, plan in enumerate(PLANS)]
    return write_annotated(tmp_path_factory.mktemp("toy"), made)


@pytest.fixture(scope="session")
def annotated(annotated_root: Path) -> AnnotatedStore:
    return load_annotated(annotated_root)


@pytest.fixture(scope="session")
def batch(annotated: AnnotatedStore) -> ClipBatch:
    """The three training clips: left, right and both hands, of different length."""
    return collate(list(HoiDataset(annotated, "train")))


@pytest.fixture(scope="session")
def trained(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint of each of Text2HOI's networks, of the toy dataset."""
    out = tmp_path_factory.mktemp("checkpoints")
    for name in PARAMS:
        train(name, annotated_root, out)
    return out
