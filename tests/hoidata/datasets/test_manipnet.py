"""ManipNet's adapter on a tree written by hand from the format notes: left-handed, decimetres, 120 Hz, 17-joint hands.

Every expected joint is worked out in the files' own left-handed world, link by link, and only then seen in the mirror.
"""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from hoidata.clips.clip import Clip
from hoidata.conformance.check import check_adapter
from hoidata.datasets import Quarantined, RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, object_words, read_recording, thirty_fps_frames
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_joints

# A right hand in the files' axes: fingers to -x, thumb side +y, palm to -z. "~" is "-" on the right, "" on the left.
HAND = """HIERARCHY
ROOT WRIST
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT THUMB_CMC_FE { OFFSET ~0.20 0.12 -0.05 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT THUMB_CMC_AA { OFFSET ~0.18 0.16 -0.10 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT THUMB_MCP_FE { OFFSET ~0.28 0.20 -0.06 CHANNELS 3 Yrotation Xrotation Zrotation
        JOINT THUMB_IP_FE { OFFSET ~0.30 0.22 -0.04 CHANNELS 3 Yrotation Xrotation Zrotation
          End Site { OFFSET 0.0 0.0 0.0 } } } } }
  JOINT INDEX_MCP { OFFSET ~1.05 0.25 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT INDEX_PIP_FE { OFFSET ~0.41 0.02 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT INDEX_DIP_FE { OFFSET ~0.26 0.01 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
  JOINT MIDDLE_MCP { OFFSET ~1.04 0.02 0.03 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT MIDDLE_PIP_FE { OFFSET ~0.46 0.00 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT MIDDLE_DIP_FE { OFFSET ~0.30 0.00 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
  JOINT RING_MCP { OFFSET ~0.97 -0.19 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT RING_PIP_FE { OFFSET ~0.42 -0.01 0.02 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT RING_DIP_FE { OFFSET ~0.28 -0.02 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
  JOINT PINKY_MCP { OFFSET ~0.86 -0.38 -0.07 CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT PINKY_PIP_FE { OFFSET ~0.33 -0.02 0.01 CHANNELS 3 Yrotation Xrotation Zrotation
      JOINT PINKY_DIP_FE { OFFSET ~0.22 -0.03 0.00 CHANNELS 3 Yrotation Xrotation Zrotation
        End Site { OFFSET 0.0 0.0 0.0 } } } }
}
MOTION
Frames: %d
Frame Time: 0.008333334
"""
THING = """HIERARCHY
ROOT tetra_large
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  End Site { OFFSET 0.0 0.0 0.0 }
}
MOTION
Frames: %d
Frame Time: 0.008333334
"""
# No mirror symmetry: four corners at different distances.
TETRA = (
    "v 0.5 0.0 0.0\nv 0.0 0.4 0.0\nv 0.0 0.0 0.3\nv -0.2 -0.3 -0.1\nf 1/1/1 2/2/2 3/3/3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n"
)
TIPS = {
    "THUMB_IP_FE": [-0.21, 0.17, -0.02],
    "INDEX_DIP_FE": [-0.25, 0.02, 0.01],
    "MIDDLE_DIP_FE": [-0.28, 0.03, -0.02],
    "RING_DIP_FE": [-0.27, 0.0, -0.01],
    "PINKY_DIP_FE": [-0.24, -0.01, -0.01],
}
REFERENCE = {"capsules": [{"joint": joint, "end_local": end} for joint, end in TIPS.items()]}
# Columns of a hand row: place, turn of the wrist, then (Y, X, Z) degrees of the sixteen other joints in file order.
POSE = [
    *(1.5, 2.0, -0.5, 40.0, -30.0, 20.0),
    *(10.0, -5.0, 8.0, 12.0, 20.0, -15.0, 5.0, 6.0, 7.0, -8.0, 9.0, -10.0),
    *(-15.0, 10.0, 5.0, -30.0, 2.0, 3.0, -20.0, 4.0, -5.0),
    *(-18.0, 1.0, 2.0, -35.0, 3.0, 4.0, -22.0, 5.0, 6.0),
    *(-21.0, 7.0, 8.0, -38.0, 9.0, 10.0, -24.0, 11.0, 12.0),
    *(-25.0, 13.0, 14.0, -40.0, 15.0, 16.0, -26.0, 17.0, 18.0),
]
FLAT = [0.0] * 48
MIRROR = np.array([-1.0, 1.0, 1.0])
HANDS = load_embedded_hands()
KEY = SequenceKey("manipnet", "manipnet", "tetra_large7")


def turn_yxz(degrees: list[float]) -> np.ndarray:
    (cy, cx, cz), (sy, sx, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_y @ about_x @ about_z


def write_gz(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def motion_text(head: str, rows: list[list[float]]) -> str:
    return head % len(rows) + "\n".join(" ".join(f"{value:.6f}" for value in row) + " " for row in rows) + "\n"


def write_tree(root: Path, left: list, right: list, thing: list, name: str = "tetra_large7") -> RawTree:
    folder = root / "sequences" / name
    write_gz(folder / "leftHand.bvh.gz", motion_text(HAND.replace("~", ""), left))
    write_gz(folder / "rightHand.bvh.gz", motion_text(HAND.replace("~", "-"), right))
    write_gz(folder / "tetra_large.bvh.gz", motion_text(THING, thing))
    write_gz(root / "objects" / "Primitive" / "tetra_large.obj.gz", TETRA)
    (root / "hand").mkdir(exist_ok=True)
    (root / "hand" / "hand_reference.json").write_text(json.dumps(REFERENCE))
    return RawTree(root)


def mirrored_row(row: list[float]) -> list[float]:
    """The same hand row for the other side, seen in a mirror with normal x."""
    flips = [-1.0, 1.0, 1.0] + [-1.0, 1.0, -1.0] * 17
    return [value * flip for value, flip in zip(row, flips, strict=True)]


def nine_frames(row: list[float]) -> list[list[float]]:
    """``row`` at source frames 0, 4 and 8 (moved on by 1 dm each), and rows that must not be read in between."""
    frames = [[value + 33.0 for value in row] for _ in range(9)]
    for step in range(3):
        frames[4 * step] = [row[0] + step, *row[1:]]
    return frames


@pytest.fixture
def small_tree(tmp_path: Path) -> RawTree:
    thing = nine_frames([0.4, 1.2, 2.5, 35.0, -25.0, 15.0])
    return write_tree(tmp_path, nine_frames(mirrored_row(POSE)), nine_frames(POSE), thing)


def test_joints_of_the_literal_hand_are_its_chains_written_out_and_mirrored(small_tree: RawTree) -> None:
    keypoints_m = read_recording(small_tree, KEY.name).keypoints_m["right"]
    wrist, hand = np.array(POSE[:3]), turn_yxz(POSE[3:6])
    cmc_fe = hand @ turn_yxz(POSE[6:9])
    cmc_aa = cmc_fe @ turn_yxz(POSE[9:12])
    mcp = cmc_aa @ turn_yxz(POSE[12:15])
    ip = mcp @ turn_yxz(POSE[15:18])
    thumb1 = wrist + hand @ [-0.20, 0.12, -0.05] + cmc_fe @ [-0.18, 0.16, -0.10]
    thumb2 = thumb1 + cmc_aa @ [-0.28, 0.20, -0.06]
    thumb3 = thumb2 + mcp @ [-0.30, 0.22, -0.04]
    index, pip, dip = (turn_yxz(POSE[i : i + 3]) for i in (18, 21, 24))
    index1 = wrist + hand @ [-1.05, 0.25, 0.01]
    index2 = index1 + hand @ index @ [-0.41, 0.02, 0.0]
    index3 = index2 + hand @ index @ pip @ [-0.26, 0.01, 0.0]
    pinky, pinky_pip = turn_yxz(POSE[45:48]), turn_yxz(POSE[48:51])
    pinky1 = wrist + hand @ [-0.86, -0.38, -0.07]
    pinky3 = pinky1 + hand @ pinky @ [-0.33, -0.02, 0.01] + hand @ pinky @ pinky_pip @ [-0.22, -0.03, 0.0]
    expected = {
        0: wrist,
        1: index1,
        2: index2,
        3: index3,
        7: pinky1,
        9: pinky3,
        10: wrist + hand @ [-0.97, -0.19, 0.0],
        4: wrist + hand @ [-1.04, 0.02, 0.03],
        13: thumb1,
        14: thumb2,
        15: thumb3,
        16: index3 + hand @ index @ pip @ dip @ TIPS["INDEX_DIP_FE"],
        18: pinky3 + hand @ pinky @ pinky_pip @ turn_yxz(POSE[51:54]) @ TIPS["PINKY_DIP_FE"],
        20: thumb3 + ip @ TIPS["THUMB_IP_FE"],
    }
    for joint, point in expected.items():
        np.testing.assert_allclose(keypoints_m[0, joint], point * MIRROR * 0.1, atol=1e-6, err_msg=str(joint))


def test_every_fourth_frame_from_frame_zero_is_read(small_tree: RawTree) -> None:
    recording = read_recording(small_tree, KEY.name)
    np.testing.assert_array_equal(recording.source_frames, [0, 4, 8])
    wrist_m = recording.keypoints_m["right"][:, 0]
    np.testing.assert_allclose(wrist_m, [[-0.15, 0.2, -0.05], [-0.25, 0.2, -0.05], [-0.35, 0.2, -0.05]], atol=1e-6)


def test_the_left_hand_is_the_mirror_image_of_the_same_right_hand(small_tree: RawTree) -> None:
    keypoints_m = read_recording(small_tree, KEY.name).keypoints_m
    np.testing.assert_allclose(keypoints_m["left"][0], keypoints_m["right"][0] * MIRROR, atol=1e-6)


def test_the_right_hand_stays_a_right_hand(small_tree: RawTree) -> None:
    """From the back of a right hand with fingers up, the thumb is on the left: a triple product with a known sign."""
    points = read_recording(small_tree, KEY.name).keypoints_m["right"][0]
    palm = turn_yxz(POSE[3:6]) @ [0.0, 0.0, -1.0] * MIRROR
    fingers, thumb_side = points[4] - points[0], points[1] - points[10]
    assert np.dot(np.cross(fingers, thumb_side), palm) < 0
    rest = HANDS.right.rest_joints_m(np.zeros((1, 10)))[0]
    assert np.cross(rest[4] - rest[0], rest[1] - rest[10])[1] > 0  # the model's back of the hand is +y


def test_an_asymmetric_mesh_lies_where_the_notes_put_it(small_tree: RawTree) -> None:
    recording = read_recording(small_tree, KEY.name)
    corners = np.array([[0.5, 0, 0], [0, 0.4, 0], [0, 0, 0.3], [-0.2, -0.3, -0.1]])
    left_handed = (corners * MIRROR) @ turn_yxz([35.0, -25.0, 15.0]).T + [0.4, 1.2, 2.5]
    placed = recording.model.vertices_m @ recording.rotation[0].T + recording.translation_m[0]
    np.testing.assert_allclose(placed, left_handed * MIRROR * 0.1, atol=1e-6)
    a, b, c = (recording.model.vertices_m[i] for i in recording.model.faces[0])
    centre = recording.model.vertices_m.mean(axis=0)
    assert np.dot(np.cross(b - a, c - a), a - centre) > 0  # faces still look outward


def lift_rows(n_frames: int = 600) -> tuple[list, list, list]:
    """A flat right hand whose palm carries the object 30 cm up after half a second; the left hand waits nearby."""
    left, right, thing = [], [], []
    for frame in range(n_frames):
        sway = 0.002 * np.sin(frame / 9)
        height = 1.0 + 3.0 * np.clip((frame - 60) / 240, 0, 1)
        right.append([sway, height, 0.0, *[0.0] * 3, *FLAT])
        left.append([-6.0 + sway, 1.5, 0.0, *[0.0] * 3, *FLAT])
        thing.append([-0.9 + sway, height, -0.4, 0.0, 0.0, 0.0])
    return left, right, thing


def load(raw: RawTree) -> tuple[list[Clip], list[Quarantined]]:
    results = ManipNetAdapter().load(raw, KEY, HANDS)
    return [x for x in results if isinstance(x, Clip)], [x for x in results if isinstance(x, Quarantined)]


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> tuple[RawTree, Clip]:
    """The raw tree of one lift and the single clip it gives."""
    raw = write_tree(tmp_path_factory.mktemp("carried"), *lift_rows())
    (clip,), left_out = load(raw)
    assert not left_out
    return raw, clip


def test_a_carried_object_becomes_one_clip_that_says_what_was_seen(carried: tuple[RawTree, Clip]) -> None:
    _, clip = carried
    assert (clip.verb, clip.object_words, clip.labelled_hand) == ("lift", "large tetrahedron", None)
    assert clip.clip_id == "manipnet/tetra_large7/000000-000596"
    assert np.array_equal(clip.source_frames, np.arange(0, 600, 4))
    np.testing.assert_array_equal(clip.gravity, [0, -1, 0])
    assert clip.source_fps == pytest.approx(120, abs=0.01)
    assert {source.path for source in clip.sources} == {
        "hand/hand_reference.json",
        "objects/Primitive/tetra_large.obj.gz",
        *(f"sequences/tetra_large7/{name}.bvh.gz" for name in ("leftHand", "rightHand", "tetra_large")),
    }


def test_the_fitted_hands_follow_the_recorded_joints(carried: tuple[RawTree, Clip]) -> None:
    raw, clip = carried
    recording = read_recording(raw, KEY.name)
    for side, keypoints_m in recording.keypoints_m.items():
        error_m = np.linalg.norm(track_joints(clip.hands[side], HANDS[side]) - keypoints_m, axis=-1)
        assert error_m.mean() < 0.010
        assert error_m[:, 16:].mean() < 0.005
        assert clip.hands[side].valid.all()


def test_the_way_back_leads_to_the_files_own_numbers(carried: tuple[RawTree, Clip]) -> None:
    _, clip = carried
    world = np.append(clip.object.translation_m[-1], 1.0)
    sway = 0.002 * np.sin(596 / 9)
    np.testing.assert_allclose((clip.source_from_world @ world)[:3], [-0.9 + sway, 4.0, -0.4], atol=1e-5)
    corner = (clip.object.world_from_object @ clip.object.model.vertices_m)[-1, 0]
    np.testing.assert_allclose(corner * 10 * MIRROR, [-0.9 + sway - 0.5, 4.0, -0.4], atol=1e-5)


def test_frozen_and_jumping_stretches_are_cut_out_and_listed(tmp_path: Path) -> None:
    left, right, thing = lift_rows(1200)
    for rows in (left, right, thing):
        rows[800:900] = [rows[800]] * 100
    for frame in range(400, 1200):
        thing[frame] = [thing[frame][0] - 0.15, *thing[frame][1:]]
    clips, left_out = load(write_tree(tmp_path, left, right, thing))
    reasons = {item.source_key: item.got for item in left_out}
    assert reasons["manipnet/tetra_large7/000800-000899"] == "100 exactly equal frames"
    assert reasons["manipnet/tetra_large7/000398-000401"].startswith("object jumps 1.5 cm")
    for clip in clips:
        assert not np.isin(clip.source_frames, [*range(398, 402), *range(800, 900)]).any()
        assert np.array_equal(np.diff(clip.source_frames), np.full(clip.n_frames - 1, 4))
    assert len(clips) >= 3


def test_a_wrist_far_from_the_object_is_cut_out(tmp_path: Path) -> None:
    left, right, thing = lift_rows()
    for frame in range(500, 600):
        left[frame][0] = -6.0 - (frame - 499) * 0.08
    _, left_out = load(write_tree(tmp_path, left, right, thing))
    assert [(item.expected, item.got) for item in left_out] == [
        ("both wrists within 1 m of the object", "a wrist 1.33 m away")
    ]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda s: (s / "rightHand.bvh.gz").unlink(), "no sequences/tetra_large7/rightHand.bvh.gz"),
        (lambda s: [(s / f"{side}Hand.bvh.gz").unlink() for side in ("left", "right")], "object motion only"),
        (lambda s: (s / "tetra_large.bvh.gz").unlink(), "expected motion of one object, got 0"),
        (lambda s: (s / "rightHand.bvh.gz").write_bytes((s / "leftHand.bvh.gz").read_bytes()[:300]), "gzipped text"),
        (lambda s: write_gz(s / "rightHand.bvh.gz", motion_text(THING, [[0.0] * 6] * 9)), "17 joints"),
        (lambda s: write_gz(s / "tetra_large.bvh.gz", motion_text(THING, [[0.0] * 6] * 8)), "9 frames .* got 8 frames"),
        (lambda s: write_gz(s / "leftHand.bvh.gz", motion_text(HAND.replace("~", ""), [[0.0] * 53] * 9)), "54 columns"),
        (lambda s: (s / "tetra_large.bvh.gz").rename(s / "teapot9.bvh.gz"), r"objects/\*/teapot9.obj.gz"),
        (
            lambda s: write_gz(s.parents[1] / "objects/Primitive/tetra_large.obj.gz", "v 1 2\nf 1 2 3"),
            "tetra_large.obj",
        ),
        (lambda s: (s.parents[1] / "hand/hand_reference.json").write_text('{"capsules": [1]}'), "hand_reference.json"),
    ],
)
def test_damaged_sequences_are_refused_with_file_expected_and_got(small_tree: RawTree, damage, message: str) -> None:
    damage(small_tree.root / "sequences" / KEY.name)
    with pytest.raises(BadInput, match=message):
        ManipNetAdapter().load(small_tree, KEY, HANDS)


def test_a_damaged_neighbour_does_not_stop_a_sequence(tmp_path: Path) -> None:
    raw = write_tree(tmp_path, *lift_rows())
    write_gz(tmp_path / "sequences" / "broken" / "leftHand.bvh.gz", "HIERARCHY")
    keys = ManipNetAdapter().sequences(tmp_path)
    assert [str(key) for key in keys] == ["manipnet/broken", "manipnet/tetra_large7"]
    assert len(load(raw)[0]) == 1


def test_times_not_frame_numbers_decide_at_other_rates() -> None:
    np.testing.assert_array_equal(thirty_fps_frames(8000, 0.008333334), np.arange(0, 8000, 4))
    frames = thirty_fps_frames(8000, 0.00862069)
    np.testing.assert_allclose(frames * 0.00862069, np.arange(len(frames)) / 30, atol=0.5 * 0.00862069)
    assert 0 <= (7999 - frames[-1]) * 0.00862069 < 1 / 30


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cyl_med", "medium cylinder"),
        ("cube_med", "medium cube"),
        ("tri_prism_large", "large triangular prism"),
        ("mug1", "mug"),
        ("bottle4_body", "bottle"),
        ("teapot2", "teapot"),
        ("wineglass3", "wine glass"),
        ("sphere", "sphere"),
    ],
)
def test_file_names_become_words(name: str, words: str) -> None:
    assert object_words(name) == words


@pytest.mark.slow
def test_a_margin_keeps_usable_frames_around_the_interaction_under_the_same_id_and_verb(tmp_path: Path) -> None:
    """The hand comes down on the object until frame 100, which is lifted from frame 150; frames 8 to 11 are a jump."""
    left, right, thing = lift_rows()
    for frame in range(600):
        height = 1.0 + 3.0 * np.clip((frame - 150) / 240, 0, 1)
        thing[frame][:2] = [thing[frame][0] + (0.5 if frame < 10 else 0.0), height]
        right[frame][1] = height + max(0.0, (100 - frame) / 40)
    raw = write_tree(tmp_path, left, right, thing)
    (without,) = (item for item in ManipNetAdapter().load(raw, KEY, HANDS) if isinstance(item, Clip))
    (some,) = (item for item in ManipNetAdapter(margin_frames=5).load(raw, KEY, HANDS) if isinstance(item, Clip))
    (all_there_are,) = (
        item for item in ManipNetAdapter(margin_frames=99).load(raw, KEY, HANDS) if isinstance(item, Clip)
    )
    first = int(without.source_frames[0])
    assert 40 < first < 120
    np.testing.assert_array_equal(some.source_frames, np.arange(first - 20, 600, 4))
    np.testing.assert_array_equal(all_there_are.source_frames, np.arange(12, 600, 4))
    assert {(clip.clip_id, clip.verb) for clip in (without, some, all_there_are)} == {(without.clip_id, "lift")}


def test_clips_say_that_their_hands_were_fitted_to_keypoints_and_how_well(carried: tuple[RawTree, Clip]) -> None:
    raw, clip = carried
    recording = read_recording(raw, KEY.name)
    error_m = [
        np.linalg.norm(track_joints(clip.hands[side], HANDS[side]) - points, axis=-1)
        for side, points in recording.keypoints_m.items()
    ]
    assert clip.hands_from == "keypoints"
    assert clip.fit_error_m == pytest.approx(np.mean(error_m), abs=1e-6)


@pytest.mark.slow
def test_it_keeps_every_rule_of_the_conformance_check(tmp_path: Path) -> None:
    """Two lifts of one subject; the hands lie flat beside the object, so that touch is of no account."""
    left, right, thing = lift_rows(280)
    write_tree(tmp_path, left, right, thing, "tetra_large7")
    bent = [[*row[:6], *[value / 8 for value in POSE[6:]]] for row in right]
    write_tree(tmp_path, left, bent, thing, "tetra_large8")
    found = {item.rule: item for item in check_adapter(ManipNetAdapter(), tmp_path, HANDS, worker=False)}
    assert [item for item in found.values() if item.outcome == "fail"] == []
    removed = found["clips stay the same when another sequence is removed"]
    assert removed.outcome == "pass"


def test_a_margin_that_is_no_whole_number_is_refused() -> None:
    with pytest.raises(BadInput, match="whole number of 0 or more"):
        ManipNetAdapter(margin_frames=-1)
