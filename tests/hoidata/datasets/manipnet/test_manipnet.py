"""ManipNet's adapter on a tree written by hand from the format notes: left-handed, decimetres, 120 Hz, 17-joint hands.

Every expected joint is worked out in the files' own left-handed world, link by link, and only then seen in the mirror.
"""

from pathlib import Path

import numpy as np
import pytest

from hoidata.clips.clip import Clip
from hoidata.datasets import Quarantined, RawTree
from hoidata.datasets.manipnet.adapter import ManipNetAdapter, object_words, read_recording, thirty_fps_frames
from hoidata.hands import load_embedded_hands, track_joints
from tests.builders.manipnet import KEY, MIRROR, lift_rows, write_tree

HANDS = load_embedded_hands()


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_touch_that_is_short_because_tracking_failed_says_so(tmp_path: Path) -> None:
    left, right, thing = lift_rows(280)
    for frame in range(140, len(thing)):  # the object jumps 1.5 cm: touches of 34 frames on both sides
        thing[frame][1] += 0.15
    _, left_out = load(write_tree(tmp_path, left, right, thing))
    short = [item.got for item in left_out if item.expected == "45 frames or more"]
    assert len(short) == 2
    assert all(got.endswith(", next to frames that are left out") for got in short)


@pytest.mark.slow
def test_a_wrist_far_from_the_object_is_cut_out(tmp_path: Path) -> None:
    left, right, thing = lift_rows()
    for frame in range(500, 600):
        left[frame][0] = -6.0 - (frame - 499) * 0.08
    _, left_out = load(write_tree(tmp_path, left, right, thing))
    assert [(item.expected, item.got) for item in left_out] == [
        ("both wrists within 1 m of the object", "a wrist 1.33 m away")
    ]


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
