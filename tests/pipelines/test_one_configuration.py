"""The settings of the contact stage reach labels, masks, losses and pages; each default is defined once."""

import ast
import json
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from hoidata.batches.dataset import HoiDataset, collate
from hoidata.contact.settings import ContactSettings
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.settings import plain_config
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from models.common import losses
from pipelines.commands.settings import SECTIONS, settings_class
from pipelines.pages.report import touch_words
from pipelines.stages import annotate, contact, evaluate, quality, split
from pipelines.stages.base import StagePaths

PROJECT = Path(__file__).parents[2]
PATHS = StagePaths("embedded", "grab")
THRESHOLD_M = {"wide": 0.02, "narrow": 0.01}
SHIFT_M = np.float32([0.006, 0.004, 0.004])
RULE = {"by": "subject", "train": "rest", "validation": ["s9"], "test": ["s10"]}
# In params.yaml although it equals the default, because users look for it there.
SHOWN_ON_PURPOSE = {"annotate.encoder"}
# Constants with the value of the contact threshold and another meaning.
OTHER_LENGTHS = {
    "LONGEST_EDGE_M", "STAND_RADIUS_M", "LARGEST_DISTANCE_M", "REACH_M", "HANDS_BELOW", "TOUCH_M",
    "GUIDANCE_RANGE_M", "MAX_BELOW_FRACTION", "FADES_M", "DEEP_M", "TRAVEL_M",
    "STILL_M_S", "MOVING_M_S", "MIN_GAIN", "OUTLIER_M",
}  # fmt: skip


def annotated_at(folder: Path, threshold_m: float, make_clip, monkeypatch) -> AnnotatedStore:
    """Three clips after all data stages, with only ``contact.threshold_m`` set."""
    folder.mkdir()
    shutil.copytree(PROJECT / "manifests" / "embedded", folder / "manifests" / "embedded")
    params = {"contact": {"threshold_m": threshold_m, "points": 256}, "annotate": {"encoder": "hash"}}
    params |= {"datasets": ["grab"], "families": ["ours"]}
    (folder / "params.yaml").write_text(yaml.safe_dump({**params, "split": {"grab": RULE}}))
    monkeypatch.chdir(folder)
    subjects = ("s1", "s9", "s10")
    clips = [
        make_clip(30, seed=seed, clip_id=f"grab/{name}/box_lift_1", subject=name) for seed, name in enumerate(subjects)
    ]
    write_store(PATHS.clips, clips, generated_info("grab"))
    for stage in (quality, contact, annotate, split):
        stage.run(PATHS)
    return load_annotated(folder / PATHS.data)


@pytest.fixture
def wide_and_narrow(tmp_path, make_clip, monkeypatch) -> tuple[AnnotatedStore, AnnotatedStore]:
    wide, narrow = (annotated_at(tmp_path / name, width, make_clip, monkeypatch) for name, width in THRESHOLD_M.items())
    return wide, narrow


def test_the_contact_threshold_changes_labels_hand_types_masks_and_sentences(wide_and_narrow):
    wide, narrow = wide_and_narrow
    key = wide.ids("train")[0]
    assert 0 < narrow.contact(key).sum() < wide.contact(key).sum()
    assert narrow.distances(key).distance_m.max() < 0.01 < wide.distances(key).distance_m.max()
    assert (wide.hand_evidence(key).threshold_m, narrow.hand_evidence(key).threshold_m) == (0.02, 0.01)
    assert (touch_words(wide), touch_words(narrow)) == ("within 2 cm of a joint", "within 1 cm of a joint")
    samples = [next(iter(HoiDataset(store, "train"))) for store in (wide, narrow)]
    assert [sample.contact_threshold_m for sample in samples] == [0.02, 0.01]
    np.testing.assert_array_equal(samples[1].contact_map, narrow.contact(key).astype(bool))
    assert samples[1].contact_map.sum() < samples[0].contact_map.sum()


def test_the_losses_of_a_batch_use_the_threshold_of_its_data(wide_and_narrow):
    batches = [collate(list(HoiDataset(store, "train"))) for store in wide_and_narrow]
    apart = torch.tensor([0.005, 0.015, -0.015, 0.025])
    touching = [losses.touching_joints(apart, batch.contact_threshold_m).tolist() for batch in batches]
    assert touching == [[True, True, True, False], [True, False, False, False]]


def test_metrics_use_the_threshold_of_the_contact_stage(wide_and_narrow, tmp_path, monkeypatch):
    paths, metrics = replace(PATHS, family="ours"), {}
    for name, store in zip(("wide", "narrow"), wide_and_narrow, strict=True):
        monkeypatch.chdir(tmp_path / name)
        [key] = store.ids("test")
        recorded = store.clip(key)
        predicted = replace(
            recorded,
            hands={side: replace(hand, wrist_m=hand.wrist_m + SHIFT_M) for side, hand in recorded.hands.items()},
        )
        write_store(paths.samples / "clips", [predicted], generated_info("ours"))
        (paths.samples / "diagnostics.json").write_text("{}")
        evaluate.run(paths)
        metrics[name] = json.loads((paths.metrics / "ours.json").read_text())
        touched = [
            touched_points(clip, store.points(store.object_key(key)).points_m, THRESHOLD_M[name])
            for clip in (predicted, recorded)
        ]
        f1 = 2 * (touched[0] & touched[1]).sum() / (touched[0].sum() + touched[1].sum())
        assert metrics[name]["figures"]["contact_f1"] == pytest.approx(f1, abs=1e-6)
    values = [metrics[name]["counts"]["contact_distance_mm"]["values"] for name in ("narrow", "wide")]
    assert 0 < values[0] < values[1]


def touched_points(clip, points_m: np.ndarray, threshold_m: float) -> np.ndarray:
    """(point,) bool, points of a rigid object that the right hand touches, from all distances to its joints."""
    world = track_joints(clip.hands["right"], load_embedded_hands().right)
    turns = Rotation.from_rotvec(clip.object.rotvec).as_matrix()
    joints = np.einsum("fji,fkj->fki", turns, world - clip.object.translation_m[:, None])
    return (np.linalg.norm(joints[:, :, None] - points_m, axis=-1) < threshold_m).any(axis=(0, 1))


def test_params_repeat_no_defaults_of_the_library():
    params = yaml.safe_load((PROJECT / "params.yaml").read_text())
    repeated = set()
    for section in SECTIONS:
        defaults = plain_config(settings_class(section)())
        said = params[section] or {}
        same = {f"{section}.{name}" for name, value in said.items() if value is not None and value == defaults[name]}
        repeated |= same
    assert repeated == SHOWN_ON_PURPOSE


@pytest.mark.slow
def test_threshold_and_number_of_points_are_defined_once():
    """Of all constants and default values in the code, one is the threshold and one the number of points."""
    homes: dict[float, list[str]] = {0.02: [], 1024: []}
    for room in ("hoidata", "models", "pipelines"):
        for path in sorted((PROJECT / room).rglob("*.py")):
            for name, value in constants(ast.parse(path.read_text(encoding="utf-8"))):
                if value in homes and ("threshold" in name.lower() or "point" in name.lower() or name.isupper()):
                    homes[value].append(name)
    assert [name for name in homes[0.02] if name not in OTHER_LENGTHS] == ["CONTACT_THRESHOLD_M"]
    assert homes[1024].count("POINT_COUNT") == 1
    assert {item.name: item.default for item in fields(ContactSettings)} == {"points": 1024, "threshold_m": 0.02}


def constants(tree: ast.Module) -> list[tuple[str, float]]:
    """(name, number) of all assignments, annotated fields and default values of arguments."""
    assignments: list[tuple[ast.expr | ast.arg, ast.expr | None]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            assignments += [(target, node.value) for target in node.targets]
        elif isinstance(node, ast.AnnAssign):
            assignments.append((node.target, node.value))
        elif isinstance(node, ast.arguments):
            positional = [*node.posonlyargs, *node.args]
            assignments += list(zip(positional[len(positional) - len(node.defaults) :], node.defaults, strict=True))
            assignments += list(zip(node.kwonlyargs, node.kw_defaults, strict=True))
    names = ((getattr(target, "id", None) or getattr(target, "arg", ""), value) for target, value in assignments)
    return [(name, value.value) for name, value in names if isinstance(value, ast.Constant) and name]
