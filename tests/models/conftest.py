"""A small annotated dataset for the models: hands approach an object, carry it and release it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.clips.clip import Clip, ObjectTrack
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import ObjectModel
from hoidata.store.annotated import AnnotatedStore, load_annotated
from models.common.corpus import Corpus
from models.common.family import Sources
from tests.builders.clips import clip_of, flat_hand
from tests.builders.objects import box_model, notebook
from tests.builders.stores import write_annotated
from tests.models.toy import FAST, PAPER, PARAMS, train

GRASP_HEIGHT_M = 0.01


BOX, FOLDER = box_model((0.06, 0.06, 0.1)), notebook(0.02)


@dataclass(frozen=True)
class ToyMotion:
    subject: str
    verb: str
    model: ObjectModel
    left: bool
    right: bool
    frames: int
    height_m: float = GRASP_HEIGHT_M
    eased: bool = False


TOY_MOTIONS = (
    ToyMotion("s1", "lift", BOX, left=True, right=False, frames=24),
    ToyMotion("s1", "pass", BOX, left=False, right=True, frames=32),
    ToyMotion("s1", "open", FOLDER, left=True, right=True, frames=28),
    ToyMotion("s2", "lift", BOX, left=False, right=True, frames=25),
    ToyMotion("s2", "open", FOLDER, left=True, right=True, frames=27),
    ToyMotion("s3", "lift", BOX, left=True, right=False, frames=24),
    ToyMotion("s3", "pass", BOX, left=False, right=True, frames=33),
)


def eased(fraction: np.ndarray) -> np.ndarray:
    """``fraction`` from 0 to 1 with zero speed at both ends."""
    return (1 - np.cos(np.pi * fraction.clip(0, 1))) / 2


def make_clip(number: int, plan: ToyMotion) -> Clip:
    """Active hands are ``height_m`` above the object in the middle of the clip; inactive hands are a metre away.

    With ``eased``, the object moves smoothly in half of the clip, with hands on it all that time.
    """
    frames = plan.frames
    height, done = np.abs(np.linspace(-1, 1, frames)), np.linspace(0, 1, frames)
    if plan.eased:
        height, done = eased(2 * height - 1), eased(2 * done - 0.5)
    height, path = 0.1 * height, np.zeros((frames, 3))
    path[:, 2 if plan.verb == "lift" else 0] = 0.2 * done
    start = np.array([0.3, -0.2, 0.9])
    top = float(plan.model.vertices_m[:, 2].max()) + plan.height_m
    hands = {}
    for side, active_hands, shift in (("left", plan.left, -0.04), ("right", plan.right, 0.04)):
        wrist = path + start + np.array([shift, 0, top]) + height[:, None] * np.array([0, 0, 1.0])
        orient = np.tile(np.array([0.1 * number, 0.2, 0.0]), (frames, 1))
        track = flat_hand(wrist if active_hands else wrist + 1)
        pose, betas = np.full((frames, 45), 0.05, np.float32), np.full((1, 10), 0.3, np.float32)
        hands[side] = replace(track, global_orient=orient.astype(np.float32), hand_pose=pose, betas=betas)
    hinge = np.linspace(0, 0.6, frames).astype(np.float32) if plan.model.is_articulated else None
    rotvec = np.zeros((frames, 3), np.float32)
    rotvec[:, 2] = np.linspace(0, 0.5, frames)
    track = ObjectTrack(plan.model, rotvec, (path + start).astype(np.float32), hinge)
    return clip_of(f"toy/{plan.subject}/{number}", track, hands, verb=plan.verb)


def two_clips(folder: Path) -> Corpus:
    """A box that the right hand lifts along z in 24 frames, or passes along x in 36; also the validation clips."""
    motions = [("lift", 24), ("pass", 36)]
    clips = [
        make_clip(number, ToyMotion("s1", verb, BOX, left=False, right=True, frames=frames, height_m=-0.01, eased=True))
        for number, (verb, frames) in enumerate(motions)
    ]
    annotated = load_annotated(write_annotated(folder, clips))
    dataset = HoiDataset(annotated, "train", crop="start")
    return Corpus(annotated, dataset, dataset)


@pytest.fixture(scope="session")
def annotated_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    clips = [make_clip(number, plan) for number, plan in enumerate(TOY_MOTIONS)]
    return write_annotated(tmp_path_factory.mktemp("toy"), clips)


@pytest.fixture(scope="session")
def annotated(annotated_root: Path) -> AnnotatedStore:
    return load_annotated(annotated_root)


@pytest.fixture(scope="session")
def batch(annotated: AnnotatedStore) -> ClipBatch:
    """The three training clips: left, right and both hands, of different length."""
    return collate(list(HoiDataset(annotated, "train")))


@pytest.fixture(scope="session")
def trained(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint of each of Text2HOI's networks, trained on the toy dataset."""
    out = tmp_path_factory.mktemp("checkpoints")
    for name in PARAMS:
        train(name, annotated_root, out)
    return out


@pytest.fixture(scope="session")
def paper_trained(annotated_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As ``trained``, with networks of preset `paper`."""
    out = tmp_path_factory.mktemp("paper")
    for name in PAPER:
        train(name, annotated_root, out, params=PAPER)
    return out


@pytest.fixture(scope="session")
def sources(annotated: AnnotatedStore, trained: Path) -> Sources:
    return Sources(annotated, trained, load_embedded_hands(), device=torch.device("cpu"), settings=FAST)


@pytest.fixture(scope="session")
def samples(annotated: AnnotatedStore) -> list[ClipSample]:
    """A folder opened by both hands, and a box lifted by the left one."""
    all_samples = [clip for split in ("train", "test") for clip in HoiDataset(annotated, split, crop="start")]
    return [next(clip for clip in all_samples if clip.hand_type == hand) for hand in ("both", "left")]
