"""Promises of BimArt's comparison in bench/: every method is trained and measured, CAMS-B's stages and hands."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from bench import bimart_tables
from bench.bimart_baselines import BASIS, Placed, Stage, carried, held_joints, stages_of, targets
from bench.bimart_tables import COLUMNS, METHODS, Run
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import articulate
from hoidata.settings import build_config
from models.bimart.scene import Scene
from pipelines.stages.train import TrainParams
from tests.builders.objects import hinged_box
from tests.models.bimart.test_family import PARAMS, SETTINGS
from tests.models.bimart.test_sampling import path_features

PROJECT = Path(__file__).parents[3]


@pytest.mark.long
def test_every_method_is_trained_and_measured(annotated_root: Path, tmp_path: Path) -> None:
    section = yaml.safe_load((PROJECT / "params.yaml").read_text())["train"]
    tiny = {name: PARAMS for name in ("bimart-contact", "bimart-motion")}
    train = build_config(TrainParams, {**section, "paper": {}, "ours": {}, "small": tiny, "size": "small"}, "train")
    training = {"steps": 2, "batch": 2, "learning_rate": 0.001, "validate_every": 1}
    run = Run(annotated_root, tmp_path, load_embedded_hands(), train, training, SETTINGS["bimart"], samples=2)
    rows = bimart_tables.rows(run, list(METHODS))
    assert [row[0] for row in rows] == [method.title for method in METHODS.values()]
    motions = {name: int(row[1]) for name, row in zip(METHODS, rows, strict=True)}
    clips = motions["ground-truth"]
    assert motions == {name: clips * (method.samples or 2) for name, method in METHODS.items()}
    joints = dict(zip(METHODS, (row[2 + list(COLUMNS).index("joints, best sample, mm")] for row in rows), strict=True))
    assert float(joints["ground-truth"]) < 0.01
    assert all(float(joints[name]) > 1 for name in ("mdm-b", "omomo-b", "cams-b", "paper", "ours"))


def lid_m(scene: Scene) -> np.ndarray:
    """(5, 3) places of the lid at rest that are not the base's too."""
    model = scene.bps.model
    own = model.vertices_m[model.part == 1]
    apart = np.linalg.norm(own[:, None] - model.vertices_m[model.part == 0], axis=-1).min(axis=1)
    return own[apart > 1e-3][[0, 1, 2, 3, 0]]


def hands_on(scene: Scene, frames: slice) -> np.ndarray:
    """(2, frame, 21, 3) a left hand whose tips lie on the lid in some frames, and all else far away."""
    placed = articulate(lid_m(scene), np.ones(5, int), scene.bps.model.hinge, scene.hinge_rad)
    joints = np.full((2, len(scene), 21, 3), 3.0)
    joints[0, frames, 16:] = placed[frames]
    return joints


def clip_on(scene: Scene, joints_m: np.ndarray) -> Placed:
    acting = np.repeat([[True], [False]], len(scene), axis=1)
    return Placed(scene, np.zeros(0), joints_m, np.zeros(0), acting)


def test_a_stage_is_an_interval_in_which_each_hand_touches_the_same_part() -> None:
    scene = Scene.of(hinged_box(), path_features(30), BASIS)
    joints = hands_on(scene, slice(10, 22))
    joints[:, 15:17] = 3.0  # too short to be a stage
    stages = stages_of(joints, scene)
    assert stages == [Stage(0, 10, (-1, -1)), Stage(10, 22, (1, -1)), Stage(22, 30, (-1, -1))]
    found = targets(clip_on(scene, hands_on(scene, slice(10, 22))), stages)
    assert found[1, 0, :, 0].all()
    assert not found[[0, 2]].any()
    np.testing.assert_allclose(found[1, 0, :, 1:] * 0.05, lid_m(scene), atol=1e-5)


def test_a_hand_of_cams_b_goes_with_the_part_its_fingers_touch() -> None:
    scene = Scene.of(hinged_box(), path_features(40), BASIS)
    first = np.random.default_rng(0).normal(size=(8, 3)) * 0.05
    lid = lid_m(scene)
    fingers = np.concatenate((np.ones((5, 1)), lid / 0.05), axis=1)[None]
    made = carried(first, np.arange(5), fingers, [Stage(0, 40, (1, -1))], scene, 0)
    placed = articulate(lid, np.ones(5, int), scene.bps.model.hinge, scene.hinge_rad)
    np.testing.assert_allclose(made[15:25, :5], placed[15:25], atol=2e-3)  # smoothed in time
    still = carried(first, np.arange(5), fingers, [Stage(0, 40, (-1, -1))], scene, 0)
    np.testing.assert_allclose(still, np.broadcast_to(first, still.shape), atol=1e-9)


def test_joints_that_come_near_stay_at_their_place_of_the_part_and_others_go_on() -> None:
    own = Scene.of(hinged_box(), path_features(6), BASIS)
    model = own.bps.model
    lid = np.flatnonzero(model.part == 1)[0]
    on_lid = articulate(model.vertices_m[[lid]], np.ones(1, int), model.hinge, own.hinge_rad)[:, 0]
    joints = np.full((6, 42, 3), 5.0) + np.arange(6)[:, None, None]
    joints[2, 0] = on_lid[2] + (0, 0, 0.01)
    joints[3, 1] = model.vertices_m[np.flatnonzero(model.part == 0)[-1]] + (0, 0, 0.02)
    held = held_joints(joints, own)
    np.testing.assert_allclose(held[:2], joints[:2], rtol=1e-6)
    np.testing.assert_allclose(held[:, 2:], joints[:, 2:], rtol=1e-6)
    apart = np.linalg.norm(held[2:, 0] - on_lid[2:], axis=1)  # as far from its place of the lid at every angle
    np.testing.assert_allclose(apart, 0.01, atol=1e-5)
    assert np.abs(held[2:, 0] - held[2, 0]).max() > 1e-3
    np.testing.assert_allclose(held[3:, 1], np.broadcast_to(joints[3, 1], (3, 3)), atol=1e-6)
