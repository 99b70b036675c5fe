"""BimArt's comparison in bench/: every method is trained and measured; CAMS-B's stages and hands."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from bench import bimart_tables
from bench.bimart_baselines import (
    BASIS,
    MDM,
    OMOMO,
    CanonicalClip,
    PoseConfig,
    Stage,
    carried_keypoints,
    fixed_contact_joints,
    stages_of,
    targets,
)
from bench.bimart_tables import METHODS, TABLES, Run
from hoidata.batches.dataset import ClipSample
from hoidata.hands import load_embedded_hands
from hoidata.metrics.optional_metrics import select_metrics
from hoidata.objects.model import articulate
from hoidata.settings import build_config
from hoidata.store.annotated import WindowProtocol
from models.bimart.scene import Scene
from pipelines.stages.train import TrainParams
from tests.builders.objects import hinged_box
from tests.models.bimart.test_family import SETTINGS
from tests.models.bimart.test_sampling import path_features
from tests.models.toy import BIMART

PROJECT = Path(__file__).parents[3]


@pytest.mark.long
def test_every_method_is_trained_and_measured(annotated_root: Path, tmp_path: Path) -> None:
    section = yaml.safe_load((PROJECT / "params.yaml").read_text())["train"]
    tiny = {name: BIMART for name in ("bimart-contact", "bimart-motion")}
    train = build_config(TrainParams, {**section, "paper": {}, "ours": {}, "small": tiny, "size": "small"}, "train")
    training = {"steps": 2, "batch": 2, "learning_rate": 0.001, "validate_every": 1}
    run = Run(
        data=annotated_root,
        out=tmp_path,
        hands=load_embedded_hands(),
        train=train,
        baselines=training,
        settings=SETTINGS["bimart"],
        samples=2,
        windows=WindowProtocol(start=0, stride=9, frames=9, trimmed_end=0),
    )
    rows = bimart_tables.rows(run, list(METHODS), ["joint_error_mm"])
    assert [cells[0] for cells in rows] == [method.title for method in METHODS.values()]
    windows = int(rows[0][1].split(" of ")[1])
    expected = {
        name: f"{windows * (method.samples or 2)} in {windows} of {windows}" for name, method in METHODS.items()
    }
    counts = {name: cells[1] for name, cells in zip(METHODS, rows, strict=True)}
    expected["pressed-deep"] = counts["pressed-deep"]  # hands that never touch in a window cannot be pressed in
    assert counts == expected
    joints = {name: float(cells[3].split()[0]) for name, cells in zip(METHODS, rows, strict=True)}
    assert joints["ground-truth"] < 0.01
    assert all(joints[name] > 1 for name in ("mdm-b", "omomo-b", "cams-b", "paper", "ours"))
    steps = ("paper-without-contact", "paper-with-contact", "paper-guided", "paper")
    assert len({joints[name] for name in steps}) == len(steps)
    # A second run reads the metrics; without this method's file, it is sampled again to the same table.
    (tmp_path / "metrics" / "ours.json").unlink()
    again = bimart_tables.rows(run, list(METHODS), ["joint_error_mm"])
    assert [cells[::3] for cells in again] == [cells[::3] for cells in rows]


def test_every_metric_of_bimart_is_in_the_tables_as_released_and_corrected() -> None:
    names = [name for columns in TABLES.values() for name in columns.values()]
    metrics = [metric.name for metric in select_metrics(["bimart"]) if metric.name.startswith("bimart_")]
    assert set(metrics) - {"bimart_con_everywhere_corrected"} <= set(names)
    assert len(names) == len(set(names))


def test_omomo_b_has_an_l1_loss_and_mdm_b_a_squared_one(samples: list[ClipSample]) -> None:
    train = SimpleNamespace(ids=[samples[0].clip_id], whole=lambda _: samples[0])
    corpus = SimpleNamespace(train=train, held_out=[])
    setup: Any = SimpleNamespace(corpus=corpus, network=PoseConfig(), device=torch.device("cpu"))
    objectives: list[Any] = [network.objective(setup)[0] for network in (MDM, *OMOMO)]
    assert [float(objective.error(torch.tensor(-3.0))) for objective in objectives] == [9, 3, 3]


def lid_points_m(scene: Scene) -> np.ndarray:
    """(5, 3) vertices of the lid at rest that do not coincide with the base's."""
    model = scene.bps.model
    lid_vertices_m = model.vertices_m[model.part == 1]
    distance_m = np.linalg.norm(lid_vertices_m[:, None] - model.vertices_m[model.part == 0], axis=-1).min(axis=1)
    return lid_vertices_m[distance_m > 1e-3][[0, 1, 2, 3, 0]]


def hands_on(scene: Scene, frames: slice) -> np.ndarray:
    """(2, frame, 21, 3) a left hand whose tips are on the lid in some frames; all other joints are far away."""
    posed_m = articulate(lid_points_m(scene), np.ones(5, int), scene.bps.model.hinge, scene.hinge_rad)
    joints = np.full((2, len(scene), 21, 3), 3.0)
    joints[0, frames, 16:] = posed_m[frames]
    return joints


def clip_of_joints(scene: Scene, joints_m: np.ndarray) -> CanonicalClip:
    active = np.repeat([[True], [False]], len(scene), axis=1)
    return CanonicalClip(scene=scene, condition=np.zeros(0), joints_m=joints_m, hands=np.zeros(0), active=active)


def test_a_stage_is_an_interval_in_which_each_hand_touches_the_same_part() -> None:
    scene = Scene.of(hinged_box(), path_features(30), BASIS)
    joints = hands_on(scene, slice(10, 22))
    joints[:, 15:17] = 3.0  # too short to be a stage
    stages = stages_of(joints, scene)
    assert stages == [Stage(0, 10, (-1, -1)), Stage(10, 22, (1, -1)), Stage(22, 30, (-1, -1))]
    values = targets(clip_of_joints(scene, hands_on(scene, slice(10, 22))), stages)
    assert values[1, 0, :, 0].all()
    assert not values[[0, 2]].any()
    np.testing.assert_allclose(values[1, 0, :, 1:] * 0.05, lid_points_m(scene), atol=1e-5)


def test_a_hand_of_cams_b_moves_with_the_part_its_fingers_touch() -> None:
    scene = Scene.of(hinged_box(), path_features(40), BASIS)
    first = np.random.default_rng(0).normal(size=(8, 3)) * 0.05
    lid = lid_points_m(scene)
    fingers = np.concatenate((np.ones((5, 1)), lid / 0.05), axis=1)[None]
    moving = carried_keypoints(first, np.arange(5), fingers, [Stage(0, 40, (1, -1))], scene, 0)
    posed_m = articulate(lid, np.ones(5, int), scene.bps.model.hinge, scene.hinge_rad)
    np.testing.assert_allclose(moving[15:25, :5], posed_m[15:25], atol=2e-3)  # smoothed in time
    still = carried_keypoints(first, np.arange(5), fingers, [Stage(0, 40, (-1, -1))], scene, 0)
    np.testing.assert_allclose(still, np.broadcast_to(first, still.shape), atol=1e-9)


def test_joints_near_a_part_are_fixed_to_it_and_others_are_unchanged() -> None:
    scene = Scene.of(hinged_box(), path_features(6), BASIS)
    model = scene.bps.model
    lid = np.flatnonzero(model.part == 1)[0]
    on_lid = articulate(model.vertices_m[[lid]], np.ones(1, int), model.hinge, scene.hinge_rad)[:, 0]
    joints = np.full((6, 42, 3), 5.0) + np.arange(6)[:, None, None]
    joints[2, 0] = on_lid[2] + (0, 0, 0.01)
    joints[3, 1] = model.vertices_m[np.flatnonzero(model.part == 0)[-1]] + (0, 0, 0.02)
    fixed = fixed_contact_joints(joints, scene)
    np.testing.assert_allclose(fixed[:2], joints[:2], rtol=1e-6)
    np.testing.assert_allclose(fixed[:, 2:], joints[:, 2:], rtol=1e-6)
    distance_m = np.linalg.norm(fixed[2:, 0] - on_lid[2:], axis=1)  # constant at all hinge angles
    np.testing.assert_allclose(distance_m, 0.01, atol=1e-5)
    assert np.abs(fixed[2:, 0] - fixed[2, 0]).max() > 1e-3
    np.testing.assert_allclose(fixed[3:, 1], np.broadcast_to(joints[3, 1], (3, 3)), atol=1e-6)
