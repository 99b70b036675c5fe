"""Promises of BimArt's tables: every variant trains and answers, CAMS-B's stages and hands, Table 6's spreading."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import HoiDataset
from hoidata.clips.clip import SIDES, Clip
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import articulate
from hoidata.settings import build_config
from hoidata.store.annotated import AnnotatedStore
from models.bimart.learning import LossConfig
from models.bimart.network import DenoiserConfig
from models.bimart.scene import Scene
from models.bimart_tables.cams import CamsConfig, Stage, carried, stages_of, targets
from models.bimart_tables.mapping import spread_out
from models.bimart_tables.rows import ROWS
from models.bimart_tables.variants import VARIANTS, variant_of
from models.common.family import Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import train_network
from models.registry import load_family, load_network
from pipelines.params import laid_over
from tests.builders.objects import hinged_box
from tests.models.bimart.test_family import PARAMS, SETTINGS
from tests.models.bimart.test_sampling import path_features

HANDS = load_embedded_hands()
CAMS = {"network": {"basis": {"count": 8}, "hidden": [16], "latent": 4}}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mdm", "omomo", "cams"])
def test_every_variant_is_trained_and_answers_with_the_hands_asked_for(
    name: str, annotated_root: Path, annotated: AnnotatedStore, tmp_path: Path
) -> None:
    networks = VARIANTS[name]
    plain = {"training": {**PARAMS["training"], "steps": 1}}
    for one, changed in networks.items():
        base = {**plain, **CAMS} if one == "cams-b" else {**plain, "network": PARAMS["network"]}
        train_network(load_network(one), annotated_root, tmp_path / one, laid_over(base, changed))
    sample = next(iter(HoiDataset(annotated, "test", crop="start")))
    if "bimart-contact" not in networks:  # as the stage writes a network that a variant has not
        (tmp_path / "bimart-contact").mkdir()
    for row in ROWS[name].values():
        settings = {"bimart": laid_over(SETTINGS["bimart"], row.settings)}
        sources = Sources(annotated, tmp_path, HANDS, torch.device("cpu"), settings)
        made = load_family(row.family).load(sources).sample(requests_for(sample, PredictionConfig(samples=1)))[0]
        assert isinstance(made, Clip)
        assert [bool(made.hands[side].valid.all()) for side in SIDES] == sample.active_hands.tolist()
        assert all(np.isfinite(made.hands[side].wrist_m).all() for side in SIDES)


def test_every_variant_changes_settings_that_there_are_and_a_run_is_a_variant_with_a_seed() -> None:
    assert set(VARIANTS) == set(ROWS)
    for name, networks in VARIANTS.items():
        assert variant_of(f"{name}-3") == (name, 3)
        for one, changed in networks.items():
            config, loss = (CamsConfig, None) if one == "cams-b" else (DenoiserConfig, LossConfig)
            build_config(config, changed.get("network"), name)
            assert loss or not changed
            if loss:
                build_config(loss, changed.get("loss"), name)
    for wrong in ("part", "part-x", "parts-0"):
        with pytest.raises(BadInput, match=r"tables\.runs"):
            variant_of(wrong)


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


def test_a_stage_is_an_interval_in_which_each_hand_touches_the_same_part() -> None:
    scene = Scene.of(hinged_box(), path_features(30), CamsConfig().basis)
    joints = hands_on(scene, slice(10, 22))
    joints[:, 15:17] = 3.0  # too short to be a stage
    stages = stages_of(joints, scene)
    assert stages == [Stage(0, 10, (-1, -1)), Stage(10, 22, (1, -1)), Stage(22, 30, (-1, -1))]
    found = targets(scene, stages, hands_on(scene, slice(10, 22)), np.array([True, False]))
    assert found[1, 0, :, 0].all()
    assert not found[[0, 2]].any()
    np.testing.assert_allclose(found[1, 0, :, 1:] * 0.05, lid_m(scene), atol=1e-5)


def test_a_hand_of_cams_b_goes_with_the_part_its_fingers_touch() -> None:
    scene = Scene.of(hinged_box(), path_features(40), CamsConfig().basis)
    first = np.random.default_rng(0).normal(size=(8, 3)) * 0.05
    lid = lid_m(scene)
    fingers = np.concatenate((np.ones((5, 1)), lid / 0.05), axis=1)[None]
    made = carried(first, np.arange(5), fingers, [Stage(0, 40, (1, -1))], scene, 0)
    placed = articulate(lid, np.ones(5, int), scene.bps.model.hinge, scene.hinge_rad)
    np.testing.assert_allclose(made[15:25, :5], placed[15:25], atol=2e-3)  # smoothed in time
    still = carried(first, np.arange(5), fingers, [Stage(0, 40, (-1, -1))], scene, 0)
    np.testing.assert_allclose(still, np.broadcast_to(first, still.shape), atol=1e-9)


def test_a_map_is_spread_to_other_vertices_of_the_same_part_alone() -> None:
    model = hinged_box()
    values = np.where(model.part == 1, 5.0, 1.0)
    one_of_each = np.array([np.flatnonzero(model.part == part)[0] for part in (0, 1)])
    np.testing.assert_allclose(spread_out(model, one_of_each, values), values)
    draws = np.random.default_rng(0).normal(size=len(values))
    np.testing.assert_allclose(spread_out(model, np.arange(len(values)), draws), draws, atol=1e-3)
