"""Conventions of the exports, placeholders of untracked hands, and hostile labels."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml
from markdown_it import MarkdownIt

from hoidata.clips import SIDES, Clip
from hoidata.clips.clip import HandTrack
from hoidata.hands import JOINT_NAMES, load_embedded_hands, track_joints
from hoidata.store.info import generated_info
from hoidata.store.store import Store, open_store, write_store
from pipelines.exports.export import FORMATS, export_store
from pipelines.exports.motion import file_name_of
from tests.builders.clips import build_clip, with_hand
from tests.pipelines.exports import readers

pytestmark = pytest.mark.slow

HANDS = load_embedded_hands()
EVIL = "<img src=x onerror=alert(1)> [link](javascript:alert(1)) | a\n\n# heading ![i](http://e.org/i.png) $x$ `c`"


def personal(clip: Clip) -> Clip:
    """The clip with a personal rest mesh and zero shape coefficients, as in GRAB."""
    for side in SIDES:
        template_m = (HANDS[side].template_m * 1.1).astype(np.float32)
        clip = with_hand(clip, side, template_m=template_m, betas=np.zeros((1, 10), np.float32))
    return clip


def late_left(clip: Clip) -> Clip:
    """The clip with a left hand that is tracked in frames 2 and 4 only, and has zeros elsewhere."""
    valid = np.isin(np.arange(clip.n_frames), (2, 4))
    track = clip.hands["left"]
    zeros = {name: np.where(valid[:, None], getattr(track, name), 0) for name in ("wrist_m", "hand_pose")}
    betas = np.where(valid[:, None], np.repeat(track.betas, clip.n_frames, axis=0), 0)
    return with_hand(clip, "left", valid=valid, betas=betas, **zeros)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Store:
    """A store with personal rest meshes, a left hand tracked late, a hand never tracked, and unknown gravity."""
    hinged = build_clip(5, "both", articulated=True, seed=2, clip_id="toy/s2/open")
    absent = with_hand(build_clip(3, "right", seed=3, clip_id="toy/s3/lift"), "left", valid=np.zeros(3, bool))
    unknown = dataclasses.replace(absent, clip_id="toy/s3/float", gravity=None, gravity_note="nothing says it")
    clips = [personal(build_clip(4, "both", seed=1, clip_id="toy/s1/lift")), late_left(hinged), absent, unknown]
    folder = tmp_path_factory.mktemp("store") / "clips"
    write_store(folder, clips, generated_info("toy"))
    return open_store(folder)


@pytest.fixture(scope="module")
def exported(store, tmp_path_factory) -> dict[str, Path]:
    return readers.export_all(store, tmp_path_factory.mktemp("exported"))


def rows_of(folder: Path) -> dict[str, dict[str, Any]]:
    return {
        record["clip_id"]: record
        for path in folder.glob("data/*.parquet")
        for record in pq.read_table(path).to_pylist()
    }


def test_the_docs_name_the_tested_versions():
    page = (Path(__file__).parents[3] / "docs" / "export.md").read_text()
    tested = page.split("## Tested with")[1].split("## ")[0]
    for name in ("datasets", "lerobot", "webdataset", "mlcroissant", "usd-core", "Blender"):
        assert name in tested, name


def test_usd_files_have_a_version_that_older_releases_read(exported):
    for path in exported["usd"].glob("*.usdc"):
        assert tuple(path.read_bytes()[8:11]) <= (0, 8, 0)  # of the crate format; usd-core 20 reads 0.8.0


def test_a_hand_is_rebuilt_from_a_row_with_its_rest_mesh(store, exported):
    row = rows_of(exported["huggingface"])["toy/s1/lift"]
    for side in SIDES:
        joints, pose, orient = (np.array(row[f"{side}_{name}"]) for name in ("joints_m", "hand_pose", "global_orient"))
        template_m, betas = np.array(row[f"{side}_template_m"]), np.array(row[f"{side}_betas"])
        assert np.isnan(betas).all()  # zeros would be read as MANO's mean hand
        no_betas, valid = np.zeros((1, 10)), np.ones(len(joints), bool)
        rebuilt = HandTrack(joints[:, 0], orient, pose, no_betas, valid=valid, template_m=template_m)
        assert np.abs(track_joints(rebuilt, HANDS[side]) - joints).max() < 1e-5
        mean_hand = dataclasses.replace(rebuilt, template_m=None)
        assert np.abs(track_joints(mean_hand, HANDS[side]) - joints).max() > 0.002
    others = rows_of(exported["huggingface"])["toy/s2/open"]
    assert others["right_template_m"] == []
    assert np.allclose(others["right_betas"], store.clip("toy/s2/open").hands["right"].betas)


def test_cards_state_the_meaning_and_frame_of_all_arrays(exported):
    for name in ("huggingface", "webdataset", "lerobot"):
        card = (exported[name] / "README.md").read_text()
        assert all(f"| {column.name} |" in card and column.meaning in card for column in FORMATS[name].columns), name
    for name in FORMATS:
        card = (exported[name] / "README.md").read_text()
        assert HANDS.digest in card, name
        assert f"World frame: {FORMATS[name].world}" in card, name
    described = json.loads((exported["huggingface"] / "croissant.json").read_text())
    fields = {field["name"].split("/")[-1]: field for field in described["recordSet"][0]["field"]}
    assert "template" in fields["left_betas"]["description"]
    assert "radian" in fields["left_hand_pose"]["description"]


def test_all_formats_have_gravity_and_mark_unknown_gravity(store, exported):
    from pxr import Usd

    rows = rows_of(exported["huggingface"])
    assert rows["toy/s1/lift"]["gravity"] == [0, 0, -1]
    assert np.isnan(rows["toy/s3/float"]["gravity"]).all()
    episodes = pd.read_parquet(exported["lerobot"] / "meta/episodes").set_index("clip_id")
    assert episodes["gravity"]["toy/s1/lift"].tolist() == [0, 0, -1]
    assert np.isnan(episodes["gravity"]["toy/s3/float"]).all()
    expected = {"toy/s1/lift": [0, 0, -1], "toy/s3/float": None}
    for clip_id, gravity in expected.items():
        name = clip_id.replace("/", "__")
        assert json.loads((exported["bvh"] / name / "clip.json").read_text())["gravity"] == gravity
        scene = readers.pygltflib.GLTF2().load_binary(str(exported["glb"] / f"{name}.glb"))
        assert scene.asset.extras.get("gravity") == gravity  # glTF drops null
        stage: Any = Usd.Stage.Open(str(exported["usd"] / f"{name}.usdc"))
        assert json.loads(stage.GetDefaultPrim().GetCustomData()["facts"])["gravity"] == gravity
    # SPIDER simulates: without gravity the z axis is not defined.
    left_out = json.loads((exported["spider"] / "export.json").read_text())["left_out"]
    assert "gravity" in left_out["toy/s3/float"]
    assert "toy/s3/lift" not in left_out


def test_bvh_is_upright_in_an_importer_that_assumes_y_up(store, exported):
    """Blender's default import: y becomes z, and -z becomes y."""
    folder = exported["bvh"] / "toy__s1__lift"
    for side in SIDES:
        x, y, z = np.moveaxis(readers._of_bvh(folder / f"{side}.bvh")[:, :, :3, 3], -1, 0)
        in_blender = np.stack([x, -z, y], axis=-1)
        assert np.abs(in_blender - store.joints("toy/s1/lift", side)).max() < 1e-4  # gravity is -z in this clip
    assert len(readers._of_bvh(folder / "left.bvh")[0]) == len(JOINT_NAMES)


@pytest.mark.parametrize("name", ["lerobot", "huggingface", "webdataset", "glb", "usd"])
def test_a_hand_repeats_its_last_tracked_pose_in_all_formats(name, store, exported, tmp_path):
    only = tmp_path / "one"
    export_store(store, name, only, clip_ids=("toy/s2/open",), progress=False)
    left, right, _ = readers.read(name, only, tmp_path / "cache")["toy/s2/open"]
    assert np.abs(left - store.joints("toy/s2/open", "left")[[2, 2, 2, 2, 4]]).max() < 1e-4
    assert np.abs(right - store.joints("toy/s2/open", "right")).max() < 1e-4


def test_bvh_lists_the_frames_in_which_a_pose_is_repeated(store, exported):
    folder = exported["bvh"] / "toy__s2__open"
    facts = json.loads((folder / "clip.json").read_text())
    assert facts["untracked_frames"] == {"left": [[0, 2], [3, 4]], "right": []}
    wrist = readers._of_bvh(folder / "left.bvh")[:, 0, :3, 3]
    assert (wrist[:3] == wrist[2]).all()
    assert not (exported["bvh"] / "toy__s3__lift" / "left.bvh").exists()


def test_lerobot_statistics_exclude_placeholders(store, exported):
    folder = exported["lerobot"]
    statistics = json.loads((folder / "meta/stats.json").read_text())
    frames = pd.read_parquet(folder / "data")
    state, action = (np.stack(list(frames[name])) for name in ("observation.state", "action"))
    valid, following = (np.stack(list(frames[name])) for name in ("observation.hand_valid", "next.hand_valid"))
    assert valid[:, 0].sum() == 4 + 2  # the personal hand, and the late one
    last = np.append(np.diff(frames["episode_index"]) != 0, True)
    assert (following == np.concatenate([valid[1:], valid[:1]]) & ~last[:, None]).all()
    for name, values, mask in (("observation.state", state, valid), ("action", action, following)):
        expected = [values[mask[:, side], 63 * side : 63 * side + 63].astype(np.float64) for side in (0, 1)]
        for key, reduce in (("mean", np.mean), ("std", np.std), ("min", np.min), ("max", np.max)):
            computed = np.concatenate([reduce(joints, axis=0) for joints in expected])
            assert statistics[name][key] == pytest.approx(computed, abs=1e-6), (name, key)
    assert statistics["observation.state"]["count"] == [len(frames)]  # the right hand is tracked in all
    hinge = store.clip("toy/s2/open").object.hinge_rad
    assert hinge is not None
    assert statistics["observation.environment_state"]["mean"][7] == pytest.approx(hinge.mean())  # not of rigid objects
    assert statistics["observation.environment_state"]["min"][7] == pytest.approx(hinge.min())


def test_an_episode_without_a_hand_does_not_change_merged_statistics(store, exported):
    episodes = pd.read_parquet(exported["lerobot"] / "meta/episodes").set_index("clip_id")
    total = json.loads((exported["lerobot"] / "meta/stats.json").read_text())["observation.state"]
    absent = episodes.loc["toy/s3/lift"]
    for key in ("min", "max", "mean", "std"):
        assert absent[f"stats/observation.state/{key}"][:63] == pytest.approx(total[key][:63])
    assert absent["stats/observation.state/count"].tolist() == [3]


def test_hostile_labels_are_plain_text_in_a_card(tmp_path):
    clip = dataclasses.replace(build_clip(3), verb=EVIL, object_words=EVIL, subject=EVIL, clip_id=f"toy/{EVIL}")
    info = generated_info("toy") | {"licence": EVIL, "dataset": f"{EVIL}\n---", "where_to_register": EVIL}
    info["frame"] = info["frame"] | {"note": EVIL}
    info["hand_convention"] = info["hand_convention"] | {"note": EVIL}
    write_store(tmp_path / "clips", [clip], info)
    store = open_store(tmp_path / "clips")
    for name in FORMATS:
        export_store(store, name, tmp_path / name, for_own_use=True, progress=False)
        _, front, text = (tmp_path / name / "README.md").read_text().split("---\n", 2)
        assert yaml.safe_load(front)["pretty_name"] == f"hoidata-{EVIL}\n----synthetic"
        kinds = {token.type for token in _tokens(text)}
        assert kinds.isdisjoint({"html_block", "html_inline", "link_open", "image", "code_inline", "fence"}), name
        assert sum(token.type == "heading_open" for token in _tokens(text)) == 4, name
        assert {path.parent for path in tmp_path.glob("*")} == {tmp_path}


def _tokens(text: str) -> list[Any]:
    blocks = MarkdownIt("commonmark").enable("table").parse(text)
    return [token for block in blocks for token in (block, *(block.children or ()))]


def test_different_labels_give_different_file_names_in_the_same_folder():
    labels = [
        "a/b__c",
        "a_/b",
        "a/_b",
        "a/b/c",
        "a__b/c",
        "../c",
        "..",
        ".",
        "a/../../b",
        "/etc/x",
        "a\0b",
        "a\nb",
        "a%2Fb",
        "C:\\x",
        "x" * 400,
    ]
    names = [file_name_of(label) for label in labels]
    assert len(set(names)) == len(labels)
    for name in names:
        assert Path(name).name == name
        assert name not in ("", ".", "..")
        assert len(name.encode()) < 200
    assert file_name_of("grab/s10/apple_eat_1") == "grab__s10__apple_eat_1"


def test_an_object_with_a_path_as_name_stays_in_the_folder_of_the_export(tmp_path):
    clip = build_clip(3, "both")
    model = dataclasses.replace(clip.object.model, name="../../../../outside")
    clip = dataclasses.replace(clip, object=dataclasses.replace(clip.object, model=model))
    write_store(tmp_path / "clips", [clip], generated_info("toy"))
    export_store(open_store(tmp_path / "clips"), "spider", tmp_path / "a/b/out", progress=False)
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("a", "clips")] == []
    (mesh,) = (tmp_path / "a/b/out").rglob("visual.obj")
    info = json.loads(next((tmp_path / "a/b/out").rglob("task_info.json")).read_text())
    assert tmp_path / "a/b/out" / info["right_object_mesh_dir"] == mesh.parent
