"""Exports keep the content of the clips, and refuse data whose licence forbids sharing."""

import dataclasses
import json
import shutil
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from hoidata.clips import SIDES
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import load_annotated
from hoidata.store.fields import STORE_FILES, TABLES
from hoidata.store.info import generated_info
from hoidata.store.store import Store, open_store, write_store
from pipelines.cli import app
from pipelines.exports.export import FORMATS, export_store
from pipelines.exports.licences import KINDS, MANO, licences_of, spdx_of
from pipelines.exports.motion import Source, verbs_of
from tests.builders.clips import build_clip, with_hand
from tests.builders.stores import write_annotated, write_clips
from tests.pipelines.exports import readers

pytestmark = pytest.mark.slow

TOLERANCE = 1e-4
READ_BACK = ("lerobot", "huggingface", "webdataset", "glb", "usd", "bvh")
GRAB = "GRAB licence (MPI): non-commercial research, no redistribution"


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Store:
    """A store with a rigid and a hinged object, a personal hand, betas per frame, gravity along y, untracked frames."""
    rigid = build_clip(5, "both", seed=1, clip_id="toy/s1/lift_1", gravity=(0.0, -1.0, 0.0))
    template = load_embedded_hands().right.template_m.astype(np.float32) * np.float32(1.1)
    rigid = with_hand(rigid, "right", template_m=template)
    hinged = build_clip(4, "both", articulated=True, seed=2, clip_id="toy/s2/open_1", subject="s2", verb="open")
    betas = np.random.default_rng(0).normal(size=(4, 10)).astype(np.float32)
    hinged = with_hand(hinged, "left", betas=betas, valid=np.array([True, False, True, True]))
    root = tmp_path_factory.mktemp("toy")
    return open_store(write_annotated(root, [rigid, hinged], points=64) / "clips")


@pytest.fixture(scope="module")
def exported(store, tmp_path_factory) -> dict[str, Path]:
    return readers.export_all(store, tmp_path_factory.mktemp("exported"))


@pytest.mark.parametrize("name", READ_BACK)
def test_joints_and_object_pose_are_read_back_from_all_formats(name, store, exported, tmp_path):
    clips = readers.read(name, exported[name], tmp_path)
    assert set(clips) == set(store.ids)
    for clip_id, (left, right, world_from_object) in clips.items():
        for side, joints in zip(SIDES, (left, right), strict=True):
            expected = store.joints(clip_id, side)
            if (clip_id, side) == ("toy/s2/open_1", "left"):
                expected = expected[[0, 0, 2, 3]]  # not tracked in frame 1: the last tracked pose
            assert np.abs(joints - expected).max() <= TOLERANCE
        track = store.clip(clip_id).object
        corner = np.array([0.1, -0.1, 0.1])
        expected = Rotation.from_rotvec(track.rotvec).apply(corner) + track.translation_m
        assert np.abs(world_from_object[:, :3, :3] @ corner + world_from_object[:, :3, 3] - expected).max() <= TOLERANCE


def test_a_verb_that_the_source_does_not_name_is_the_one_derived_from_motion(tmp_path):
    clips = [build_clip(6, seed=1, clip_id=f"toy/s1/{number}", verb=verb) for number, verb in enumerate((None, "open"))]
    plain = open_store(write_clips(tmp_path / "plain", clips))
    assert verbs_of(plain) == {"toy/s1/1": "open"}
    annotated = open_store(write_annotated(tmp_path / "annotated", clips, points=64) / "clips")
    derived, label = (Source(annotated).clip(clip.clip_id).facts["verb"] for clip in clips)
    assert label == "open"
    assert derived == load_annotated(tmp_path / "annotated").verb("toy/s1/0")
    assert derived is not None


def test_annotated_verbs_replace_the_labels_in_the_description_and_in_sentences(tmp_path):
    unlabelled, labelled = (
        build_clip(6, seed=1, clip_id=f"toy/s1/{number}", verb=verb) for number, verb in enumerate((None, "lift"))
    )
    excluded = dict.fromkeys((unlabelled.clip_id, labelled.clip_id), "excluded from training")
    root = write_annotated(tmp_path / "annotated", [unlabelled, labelled], points=64, excluded=excluded)
    derived = load_annotated(root).verb(unlabelled.clip_id)
    # This store was converted again with another label, after the annotation.
    clips = [unlabelled, dataclasses.replace(labelled, verb="open")]
    store = open_store(write_clips(tmp_path / "again" / "clips", clips))
    shutil.copytree(root / "annotation", tmp_path / "again" / "annotation")
    sentences = [Source(store).clip(clip_id).sentences for clip_id in store.ids]
    assert sentences == [(f"{derived} the box",), ("lift the box",)]
    export_store(store, "croissant", tmp_path / "out", progress=False)
    (verbs,) = json.loads((tmp_path / "out" / "croissant.json").read_text())["rai:dataBiases"]
    assert verbs.endswith(f"2 verbs; most frequent: lift (1), {derived} (1)")


def test_an_export_of_some_clips_describes_these_alone(store, tmp_path):
    chosen = store.ids[1]
    facts = export_store(store, "glb", tmp_path / "one", (chosen, chosen), progress=False)
    assert facts["clips"] == 1
    card, croissant = ((tmp_path / "one" / name).read_text() for name in ("README.md", "croissant.json"))
    for text in (card, croissant):
        assert "1 clips, 4 frames, 1 objects" in text
        assert "1 subjects, 1 objects, 1 verbs; most frequent: open (1)" in text


def test_spider_gets_tips_and_object_with_z_up_and_skips_unsupported_clips(store, exported):
    folder = exported["spider"]
    (path,) = folder.rglob("trajectory_keypoints.npz")
    arrays, clip = np.load(path), store.clip("toy/s1/lift_1")
    z_up = Rotation.from_euler("x", 90, degrees=True)  # gravity is -y in this clip
    for side in SIDES:
        joints = store.joints(clip.clip_id, side)
        tips = np.stack([z_up.apply(joints[:, joint]) for joint in (20, 16, 17, 19, 18)], axis=1)
        assert np.abs(arrays[f"qpos_finger_{side}"][:, :, :3] - tips).max() <= TOLERANCE
        assert np.abs(arrays[f"qpos_wrist_{side}"][:, :3] - z_up.apply(joints[:, 0])).max() <= TOLERANCE
        to_middle = z_up.apply(joints[:, 4] - joints[:, 0])
        wrist_z = Rotation.from_quat(arrays[f"qpos_wrist_{side}"][:, [4, 5, 6, 3]]).apply([0, 0, 1])
        assert np.cross(wrist_z, to_middle) == pytest.approx(0, abs=1e-6)
    pose = arrays["qpos_obj_right"]
    assert np.abs(pose[:, :3] - z_up.apply(clip.object.translation_m)).max() <= TOLERANCE
    rotation = z_up * Rotation.from_rotvec(clip.object.rotvec)
    assert (Rotation.from_quat(pose[:, [4, 5, 6, 3]]).inv() * rotation).magnitude().max() < 1e-6
    info = json.loads((path.parents[1] / "task_info.json").read_text())
    assert (folder / info["right_object_mesh_dir"] / "visual.obj").is_file()
    assert "all hands in all frames" in json.loads((folder / "export.json").read_text())["left_out"]["toy/s2/open_1"]


def test_an_untracked_hand_is_invisible_in_usd(exported):
    from pxr import Usd, UsdGeom

    stage: Any = Usd.Stage.Open(str(exported["usd"] / "toy__s2__open_1.usdc"))
    imageable = UsdGeom.Imageable(stage.GetPrimAtPath("/world/left_hand"))
    visibility = [imageable.ComputeVisibility(frame) for frame in range(4)]
    assert visibility == ["inherited", "invisible", "inherited", "inherited"]


def test_lerobot_tasks_are_the_sentences_and_splits_are_ranges_of_episodes(store, exported):
    import pandas as pd

    folder = exported["lerobot"]
    tasks = pd.read_parquet(folder / "meta" / "tasks.parquet")
    sentences = pd.read_parquet(store.folder.parent / "annotation" / "text.parquet")["sentence"]
    assert set(tasks.index) == set(sentences)
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["splits"] == {"train": "0:1", "validation": "1:2"}


@pytest.mark.parametrize("name", FORMATS)
def test_equal_stores_give_equal_bytes(name, store, exported, tmp_path):
    export_store(open_store(store.folder), name, tmp_path / "again", progress=False)
    first, again = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (exported[name], tmp_path / "again")
    )
    assert first == again


@pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated", "ignore:The inplace keyword")  # of mlcroissant
@pytest.mark.parametrize("name", FORMATS)
def test_croissant_is_valid_and_reads_the_tables(name, store, exported, tmp_path):
    mlcroissant = pytest.importorskip("mlcroissant", reason="the extra croissant, which pyright must not see")
    folder = exported[name]
    if name == "croissant":
        folder = shutil.copytree(store.folder, tmp_path / "store")
        shutil.copy(exported[name] / "croissant.json", folder)
    dataset = mlcroissant.Dataset(jsonld=folder / "croissant.json")
    assert not dataset.metadata.ctx.issues.errors
    assert dataset.metadata.data_collection
    assert dataset.metadata.personal_sensitive_information
    if name == "croissant":
        ids = [row["meta_sequences/clip_id"].decode() for row in dataset.records("meta_sequences")]
        assert ids == store.ids


def test_the_card_names_licence_and_files(exported):
    _, front, text = (exported["huggingface"] / "README.md").read_text().split("---\n", 2)
    facts = yaml.safe_load(front)
    assert facts["license"] == "other"  # "none: generated" is not an SPDX licence
    files = [row["path"] for row in facts["configs"][0]["data_files"]]
    assert files
    assert all((exported["huggingface"] / path).is_file() for path in files)
    assert all(f"| {kind.name} |" in text for kind in KINDS)


def test_every_stored_array_has_one_licence():
    described = {file.path for file in STORE_FILES} - {"meta/info.json"} - {file.path for file in TABLES.values()}
    assert described <= {path for kind in KINDS for path in kind.arrays.replace(":", ",").split(", ")} | {
        "arrays/source_hands.npz"
    }
    frames = next(file for file in STORE_FILES if file.path == "arrays/frames-*.npz")
    patterns = [kind.arrays.split(": ")[1].split(", ") for kind in KINDS if kind.arrays.startswith(f"{frames.path}: ")]
    for field in frames.fields:
        assert sum(any(fnmatch(field.name, pattern) for pattern in group) for group in patterns) == 1, field.name


@pytest.mark.parametrize(
    ("licence", "spdx"),
    [
        ("CC BY-NC 4.0", "CC-BY-NC-4.0"),
        ("CC BY 4.0", "CC-BY-4.0"),
        ("CC0-1.0 (generated in the files of grab)", "CC0-1.0"),
        (GRAB, "LicenseRef-grab"),
    ],
)
def test_spdx_ids_of_licences(licence, spdx):
    assert spdx_of(licence, "grab") == spdx


def store_with(folder: Path, **facts: Any) -> Store:
    """A store of one clip with some facts of info.json replaced."""
    write_store(folder, [build_clip(3)], generated_info("grab") | facts)
    return open_store(folder)


@pytest.mark.parametrize("name", [name for name in FORMATS if FORMATS[name].kinds])
def test_data_that_must_not_be_shared_is_refused_with_the_licence(name, tmp_path):
    restricted = store_with(tmp_path / "clips", licence=GRAB, may_be_shared=False)
    with pytest.raises(BadInput, match=r"no redistribution \(LicenseRef-grab\).*forbids sharing this.*--for-own-use"):
        export_store(restricted, name, tmp_path / "out", progress=False)
    assert not (tmp_path / "out").exists()


def test_the_licence_of_personal_rest_meshes_counts_only_if_the_store_has_some(tmp_path):
    free = {kind: {"licence": "CC BY 4.0", "may_be_shared": True} for kind in ("hands", "object motion", "words")}
    facts = generated_info("grab") | {"licence": GRAB, "may_be_shared": False, "licences": free}
    template = load_embedded_hands().right.template_m.astype(np.float32)
    for name, clip in (("without", build_clip(3)), ("with", with_hand(build_clip(3), "right", template_m=template))):
        write_store(tmp_path / name, [clip], facts)
    export_store(open_store(tmp_path / "without"), "huggingface", tmp_path / "a", progress=False)
    with pytest.raises(BadInput, match="personal hands under"):
        export_store(open_store(tmp_path / "with"), "huggingface", tmp_path / "b", progress=False)


def test_an_export_for_own_use_is_written_and_marked(tmp_path):
    restricted = store_with(tmp_path / "clips", licence=GRAB, may_be_shared=False)
    export_store(restricted, "huggingface", tmp_path / "out", for_own_use=True, progress=False)
    for name in ("export.json", "croissant.json", "README.md"):
        assert "not to be shared" in (tmp_path / "out" / name).read_text(), name


def test_the_mano_mesh_is_not_shared_even_if_the_data_may_be(store, tmp_path):
    info = {**store.info, "licence": "CC BY 4.0", "hand_model": {"name": "mano", "digest": "0" * 64}}
    by_kind = {row.kind.name: row for row in licences_of(info)}
    assert by_kind["hands"].may_be_shared
    assert (by_kind["hand surface"].licence, by_kind["hand surface"].may_be_shared) == (MANO, False)
    with pytest.raises(BadInput, match="hand surface under: MANO"):
        export_store(dataclasses.replace(store, info=info), "usd", tmp_path / "out", progress=False)


def test_the_command_writes_a_dataset_with_sentences_and_the_docs_list_all_formats(store, tmp_path):
    arguments = ["export", str(store.folder.parent), "--to", "webdataset", "--out", str(tmp_path / "a")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert {path.name for path in (tmp_path / "a").glob("*.tar")} == {"train-000000.tar", "validation-000000.tar"}
    page = (Path(__file__).parents[3] / "docs" / "export.md").read_text()
    assert all(f"| `{name}` |" in page for name in FORMATS)
    help_text = " ".join(CliRunner().invoke(app, ["export", "--help"], env={"COLUMNS": "300"}).output.split())
    assert f"{', '.join(list(FORMATS)[:-1])} or {list(FORMATS)[-1]}" in help_text


def test_unusable_arguments_are_refused(store, tmp_path):
    (tmp_path / "there").mkdir()
    cases: list[tuple[str, dict[str, Any]]] = [
        ("one of croissant, lerobot", {"to": "fbx", "out": tmp_path / "a"}),
        ("a path that does not exist", {"to": "bvh", "out": tmp_path / "there"}),
        ("ids of clips", {"to": "bvh", "out": tmp_path / "a", "clip_ids": ("toy/s9/none",)}),
        ("all hands in all frames", {"to": "spider", "out": tmp_path / "a", "clip_ids": ("toy/s2/open_1",)}),
    ]
    for message, arguments in cases:
        with pytest.raises(BadInput, match=message):
            export_store(store, **arguments, progress=False)
    write_store(tmp_path / "empty", [], generated_info("toy"))
    with pytest.raises(BadInput, match="a store with clips"):
        export_store(open_store(tmp_path / "empty"), "bvh", tmp_path / "a", progress=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "there"]
