"""ManipNet's own hands: every capsule end worked out in the files' left-handed world, then seen in the mirror."""

import gzip
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.manipnet_hands import N_CAPSULES, read_source_hands
from hoidata.clips.clip import SIDES
from hoidata.datasets import RawTree
from hoidata.datasets.manipnet.adapter import HAND_JOINTS
from hoidata.errors import BadInput
from hoidata.physics.realism import VARIANTS, score, smoothness_m_s2

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
FRAMES = 40
MIRROR = np.array([-1.0, 1.0, 1.0])
TETRA = "v 0.5 0 0\nv 0 0.4 0\nv 0 0 0.3\nv -0.2 -0.3 -0.1\nf 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"
CAPSULE_JOINTS = ["WRIST"] * 4 + [name for name in HAND_JOINTS if name not in ("WRIST", "THUMB_CMC_FE")]


def _parents() -> list[int]:
    """All five chains start at the wrist: one of four joints, then four of three."""
    return [-1, 0, 1, 2, 3, *(index - 1 if place else 0 for index in range(5, 17) for place in [(index - 5) % 3])]


def _nested(offsets: np.ndarray) -> str:
    parents = _parents()

    def joint(index: int) -> str:
        children = [child for child, parent in enumerate(parents) if parent == index]
        place = "OFFSET " + " ".join(f"{value:.6f}" for value in offsets[index])
        inner = " ".join(joint(child) for child in children) or "End Site { OFFSET 0 0 0 }"
        channels = "3 Yrotation Xrotation Zrotation"
        if index == 0:
            head = "6 Xposition Yposition Zposition Yrotation Xrotation Zrotation"
            return f"ROOT WRIST {{ {place} CHANNELS {head} {inner} }}"
        return f"JOINT {HAND_JOINTS[index]} {{ {place} CHANNELS {channels} {inner} }}"

    return "HIERARCHY\n" + joint(0)


def _write(path: Path, hierarchy: str, rows: np.ndarray) -> None:
    lines = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in rows)
    text = f"{hierarchy}\nMOTION\nFrames: {len(rows)}\nFrame Time: 0.008333334\n{lines}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text.encode()))


def _turns(degrees: np.ndarray) -> np.ndarray:
    return Rotation.from_euler("YXZ", degrees, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """Raw root; per side offsets (17, 3) and rows (frame, 54) of the files; ends and radii of right capsules."""
    root, rng = tmp_path_factory.mktemp("manipnet"), np.random.default_rng(0)
    right = np.round(rng.normal(size=(17, 3)) * 0.3, 6)
    right[0] = 0
    offsets = {"right": right, "left": right * MIRROR}
    steps = np.linspace(0, 1, FRAMES)[:, None]
    rows = {}
    for side in SIDES:
        rows[side] = np.concatenate([[1.5, 2.0, -0.5] + steps * 0.3, 20 * rng.normal(size=51) + 10 * steps], axis=1)
        _write(root / f"sequences/tetra1/{side}Hand.bvh.gz", _nested(offsets[side]), rows[side])
    thing = "HIERARCHY ROOT tetra { OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation"
    rows["object"] = np.concatenate([[1.0, 2.0, 0.2] + steps * [0, 1, 0], [30, -20, 10] + 5 * steps], axis=1)
    _write(root / "sequences/tetra1/tetra.bvh.gz", thing + " End Site { OFFSET 0 0 0 } }", rows["object"])
    (root / "objects/Primitive").mkdir(parents=True)
    (root / "objects/Primitive/tetra.obj.gz").write_bytes(gzip.compress(TETRA.encode()))
    ends = np.round(rng.normal(size=(2, N_CAPSULES, 3)) * 0.2, 6)
    radii = np.round(rng.uniform(0.07, 0.2, N_CAPSULES), 6)
    capsules = [
        {"joint": joint, "start_local": start.tolist(), "end_local": end.tolist(), "radius": float(radius)}
        for joint, start, end, radius in zip(CAPSULE_JOINTS, *ends, radii, strict=True)
    ]
    (root / "hand").mkdir()
    (root / "hand/hand_reference.json").write_text(json.dumps({"capsules": capsules}))
    return root, offsets, rows, ends, radii


def _left_handed(offsets: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint places (17, 3) and turns (17, 3, 3) of one frame, link by link, as the files have them."""
    turns, places = _turns(row[3:].reshape(17, 3)), np.zeros((17, 3))
    places[0] = row[:3] + offsets[0]
    for index, parent in enumerate(_parents()[1:], start=1):
        places[index] = places[parent] + turns[parent] @ offsets[index]
        turns[index] = turns[parent] @ turns[index]
    return places, turns


def test_capsules_and_joints_lie_where_the_files_put_them_in_every_frame_of_120_hz(tree):
    root, offsets, rows, ends, radii = tree
    source = read_source_hands(RawTree(root), "tetra1")
    assert source.fps == pytest.approx(120, abs=0.01)
    index = [HAND_JOINTS.index(name) for name in CAPSULE_JOINTS]
    for side in SIDES:
        local = ends if side == "right" else ends * MIRROR
        for frame in (0, 17, FRAMES - 1):
            places, turns = _left_handed(offsets[side], rows[side][frame])
            expected = places[index] + np.einsum("cij,ecj->eci", turns[index], local)
            np.testing.assert_allclose(source.capsules[side].start_m[frame], expected[0] * MIRROR / 10, atol=1e-8)
            np.testing.assert_allclose(source.capsules[side].end_m[frame], expected[1] * MIRROR / 10, atol=1e-8)
            np.testing.assert_allclose(source.joints_m[side][frame, :17], places * MIRROR / 10, atol=1e-8)
            mirror = np.diag(MIRROR)
            np.testing.assert_allclose(source.wrist_rotmats[side][frame], mirror @ turns[0] @ mirror, atol=1e-8)
            tips = [CAPSULE_JOINTS.index(name) for name in ("INDEX_DIP_FE", "MIDDLE_DIP_FE", "PINKY_DIP_FE")]
            np.testing.assert_allclose(
                source.joints_m[side][frame, 17:20], source.capsules[side].end_m[frame, tips], atol=1e-12
            )
        np.testing.assert_allclose(source.capsules[side].radius_m, radii / 10)


def test_the_object_and_its_height_over_the_table_are_those_of_the_file(tree):
    root, _, rows, _, _ = tree
    source = read_source_hands(RawTree(root), "tetra1")
    corners = np.array([[0.5, 0, 0], [0, 0.4, 0], [0, 0, 0.3], [-0.2, -0.3, -0.1]])
    row = rows["object"]
    world = np.einsum("fij,cj->fci", _turns(row[:, 3:]), corners * MIRROR) + row[:, None, :3]
    ours = source.model.vertices_m @ source.poses.rotmats.transpose(0, 2, 1) + source.poses.translation_m[:, None]
    np.testing.assert_allclose(ours, world * MIRROR / 10, atol=1e-8)
    lowest = world[:, :, 1].min(axis=1) / 10
    np.testing.assert_allclose(source.lift_m, lowest - np.percentile(lowest, 3), atol=1e-8)
    np.testing.assert_array_equal(source.lifted, source.lift_m > 0.015)
    assert 0 < source.lifted.sum() < FRAMES


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: rows[:-1],
        lambda rows: [{**rows[0], "radius": -1.0}, *rows[1:]],
        lambda rows: [{**rows[0], "radius": float("nan")}, *rows[1:]],
        lambda rows: [{**rows[0], "start_local": [0, 0]}, *rows[1:]],
        lambda rows: [{**rows[0], "joint": "ELBOW"}, *rows[1:]],
        lambda rows: [{key: value for key, value in row.items() if key != "start_local"} for row in rows],
    ],
)
def test_a_reference_file_without_nineteen_sound_capsules_is_refused(tree, tmp_path, change):
    root = tree[0]
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    rows = json.loads((root / "hand/hand_reference.json").read_text())["capsules"]
    (tmp_path / "hand/hand_reference.json").write_text(json.dumps({"capsules": change(rows)}))
    with pytest.raises(BadInput, match=r"hand_reference\.json"):
        read_source_hands(RawTree(tmp_path), "tetra1")


@pytest.mark.slow
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the recordings are not part of this repository")
def test_cyl_med3_scores_as_published_facts_say_and_fails_without_hands() -> None:
    source = read_source_hands(RawTree(Path(ROOT)), "cyl_med3")
    scene = source.scene
    np.testing.assert_array_equal(scene.lifted, source.lifted)
    assert scene.capsules.radius_m.shape == (2 * N_CAPSULES,)
    np.testing.assert_array_equal(scene.capsules.start_m[:, N_CAPSULES:], source.capsules["right"].start_m)
    found = {name: score(scene, variant) for name, variant in VARIANTS.items()}
    assert 0.82 < found["SI"].share < 0.87
    assert 0.94 < found["as released"].share < 0.97
    bare = scene.with_capsules(scene.capsules.taken(slice(None), slice(0, 0)))
    assert score(bare, VARIANTS["SI"]).share == 0.0
    assert 0.16 < score(bare, VARIANTS["as released"]).share < 0.20
    assert 0.0032 < found["SI"].colliding_m < 0.0037
    for side, expected in (("left", 1.27), ("right", 1.17)):
        motion = source.motions[side]
        assert smoothness_m_s2(motion.joints_m, motion.wrist_rotmats, scene.fps) == pytest.approx(expected, abs=0.01)
