"""HOI4D's adapter on recordings written from a ground truth, and on faulty files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.annotation.sentences import english_sentences
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.validation import check_clip
from hoidata.datasets import RawTree
from hoidata.datasets.hinge import fit_hinge
from hoidata.datasets.hoi4d.adapter import Hoi4dAdapter
from hoidata.datasets.hoi4d.files import (
    EVENTS,
    action_events,
    frame_numbers,
    hinge_joint,
    match_boxes,
    upsample_rotvecs,
    upsample_values,
)
from hoidata.errors import BadInput
from hoidata.metrics.bimart import con_everywhere_corrected
from hoidata.objects.model import Hinge
from hoidata.splits.definitions import definitions_for
from tests.builders.hoi4d import (
    ANNOTATIONS,
    HANDS,
    MISSING,
    MODELS,
    MUG,
    N_FRAMES,
    SAFE,
    SCISSORS,
    SHORT,
    key_of,
    recording,
    transforms,
    write_recording,
    write_two,
)
from tests.hoidata.metrics.conftest import build_pair


def load(root, name, **settings) -> list[Clip | Quarantined]:
    return Hoi4dAdapter(**settings).load(RawTree(root), key_of(name), HANDS)


def the_clip(results) -> Clip:
    (clip,) = (item for item in results if isinstance(item, Clip))
    return check_clip(clip)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = write_two(tmp_path_factory.mktemp("hoi4d"))
    return write_recording(folder, recording(MUG, 2))


@pytest.mark.parametrize(("name", "seed"), [(SAFE, 0), (SCISSORS, 1), (MUG, 2)])
def test_a_recording_comes_back_to_its_truth_in_the_world(root, name, seed):
    written, clip = recording(name, seed), the_clip(load(root, name, clips="whole"))
    assert clip.n_frames == 2 * N_FRAMES - 1
    assert clip.recorded.tolist() == [True, False] * (N_FRAMES - 1) + [True]
    recorded_clip = clip.take(clip.recorded)
    assert recorded_clip.source_frames.tolist() == list(range(N_FRAMES))
    for part, mesh in enumerate(written.parts):
        model = clip.object.model
        rotation = Rotation.from_rotvec(written.axis * written.angle[:, None] * part)
        for frame in range(N_FRAMES):
            rest = mesh.vertices
            if written.hinged:
                assert np.array_equal(model.vertices_m[model.part == part], rest)
                rest = rotation[frame].apply(rest - written.origin) + written.origin
            else:  # a rigid mesh is centred at its bounding box
                middle = written.box_rotations[0].apply(np.zeros(3))
                rest = written.box_rotations[0].apply(model.vertices_m) + middle
            truth = rest @ written.pose[frame, :3, :3].T + written.pose[frame, :3, 3]
            result = recorded_clip.object.points_in_world(model.vertices_m, model.part)[frame][model.part == part]
            assert np.abs(result - truth).max() < 1e-4
    if written.hinged:
        assert np.rad2deg(np.abs(recorded_clip.object.hinge_rad - written.angle)).max() < 0.1
    for side in SIDES:
        orient, fingers, wrist, betas = written.hands[side]
        valid = recorded_clip.hands[side].valid
        assert np.flatnonzero(~valid).tolist() == ([MISSING, SHORT] if name == SCISSORS and side == "right" else [])
        assert np.abs(recorded_clip.hands[side].wrist_m - wrist)[valid].max() < 1e-4
        off = Rotation.from_rotvec(recorded_clip.hands[side].global_orient[valid]).inv() * Rotation.from_rotvec(
            orient[valid]
        )
        assert np.rad2deg(off.magnitude()).max() < 0.1
        assert np.abs(recorded_clip.hands[side].hand_pose[valid] - fingers).max() < 1e-5
        assert np.abs(recorded_clip.hands[side].betas - betas).max() < 1e-5
    assert np.abs(recorded_clip.camera.position_m - written.camera[:, :3, 3]).max() < 1e-5


def test_events_become_clips_with_words_and_a_faulty_hand_file_is_listed(root):
    safe = the_clip(load(root, SAFE))
    assert (safe.clip_id, safe.verb, safe.object_words) == (f"hoi4d/{SAFE}/0003-0019", "open", "safe")
    assert (safe.source_frames[0], safe.source_frames[-1], safe.subject) == (3, 18, "H3")
    result = load(root, SCISSORS)
    scissors = the_clip(result)
    assert (scissors.verb, scissors.source_frames[0], scissors.source_frames[-1]) == ("cut", 2, 19)
    (fault,) = (item for item in result if isinstance(item, Quarantined))
    assert fault.source_key == f"hoi4d/{SCISSORS}/right-{SHORT:05d}"
    assert (fault.expected, fault.got) == ("48 numbers", "1")
    assert the_clip(load(root, SCISSORS, margin_frames=3)).source_frames[0] == 1
    assert the_clip(load(root, MUG, clips="whole")).verb is None
    assert the_clip(load(root, SCISSORS, clips="whole")).verb == "cut"
    assert [str(key) for key in Hoi4dAdapter().sequences(root)] == [
        f"hoi4d/{name}" for name in sorted((SAFE, SCISSORS, MUG))
    ]


def test_its_words_make_sentences():
    verbs = {action[0] for action in EVENTS.values() if action is not None}
    assert {"pick up", "open", "cut", "turn on"} <= verbs
    for verb in verbs:
        assert verb.split()[0] in english_sentences(verb, "trash can", "right")[0].lower()


def test_interpolated_frames_are_between_recorded_ones_and_metrics_skip_them(root):
    clip = the_clip(load(root, SAFE, clips="whole"))
    interpolated = ~clip.recorded
    still = clip.take(np.repeat(np.flatnonzero(clip.recorded), 2)[:-1])
    assert np.abs(clip.object.translation_m[interpolated] - still.object.translation_m[interpolated]).max() < 0.02
    pair = build_pair(clip, clip, "both")
    assert pair.frames("left").tolist() == np.flatnonzero(clip.recorded).tolist()
    assert len(con_everywhere_corrected(pair, 1)) == N_FRAMES
    cubic = np.arange(7.0) ** 3
    assert upsample_values(cubic)[3:-3:2] == pytest.approx((np.arange(1, 5) + 0.5) ** 3)
    valid = np.array([True, True, True, False, True, True, True])
    assert upsample_values(cubic, valid)[3] == (1 + 8) / 2
    turns = Rotation.from_rotvec([[0, 0, 3.0], [0, 0, -3.0]]).as_rotvec()  # over pi, the short way
    assert upsample_rotvecs(turns)[1] == pytest.approx([0, 0, np.pi]) or upsample_rotvecs(turns)[1][2] == pytest.approx(
        -np.pi
    )


@pytest.mark.parametrize("missing", [(), (9, 10)])
def test_frames_without_an_object_file_divide_a_clip(root, tmp_path, missing):
    written = recording(MUG, 4, 40)
    write_recording(tmp_path, replace(written, events=(("Pickup", 0, 40), ("rest", 3, 9))))
    for frame in missing:
        (tmp_path / ANNOTATIONS / MUG / f"objpose/{frame}.json").unlink()
    results = load(tmp_path, MUG, shortest_frames=10)
    clips = [item for item in results if isinstance(item, Clip)]
    spans = [(int(clip.source_frames[0]), int(clip.source_frames[-1])) for clip in clips]
    assert spans == ([(0, 8), (11, 39)] if missing else [(0, 39)])
    assert all(clip.recorded[0] and clip.recorded[-1] for clip in clips)
    named = [item for item in results if isinstance(item, Quarantined) and "poses of the object" in item.expected]
    assert [item.got for item in named] == (["none in source frames 8 to 10"] if missing else [])


def test_one_frame_without_an_object_file_is_bridged_and_marked(root, tmp_path):
    """A missing frame at 15 fps and its two interpolated neighbours are three frames at 30 fps."""
    written = recording(MUG, 4, 40)
    write_recording(tmp_path, replace(written, events=(("Pickup", 0, 40),)))
    whole = the_clip(load(tmp_path, MUG))
    (tmp_path / ANNOTATIONS / MUG / "objpose/9.json").unlink()
    clip = the_clip(load(tmp_path, MUG))
    assert clip.n_frames == whole.n_frames == 79
    assert np.flatnonzero(whole.recorded & ~clip.recorded).tolist() == [18]
    assert clip.source_frames[15:22].tolist() == [7, 8, 8, 8, 8, 10, 10]
    assert clip.camera.images.tolist() == whole.camera.images.tolist()
    assert np.abs(clip.object.translation_m - whole.object.translation_m).max() < 2e-3
    apart = Rotation.from_rotvec(clip.object.rotvec) * Rotation.from_rotvec(whole.object.rotvec).inv()
    assert np.rad2deg(apart.magnitude().max()) < 1


# --- parts and hinge


def test_parts_are_matched_by_their_size_and_ambiguous_sizes_are_refused():
    meshes = np.array([[0.3, 0.2, 0.1], [0.28, 0.02, 0.1]])
    chosen, ratio = match_boxes("here", 1.05 * meshes[::-1], ["a", "b"], meshes)
    assert chosen == [1, 0]
    assert ratio == pytest.approx(1.05 * np.ones((2, 3)))
    for boxes, says in ((1.3 * meshes, "at best 30% off"), (meshes[:1], "none")):
        with pytest.raises(BadInput, match=says):
            match_boxes("here", boxes, ["a", "b"], meshes)
    with pytest.raises(BadInput, match="cannot be told"):
        match_boxes("here", meshes[[0, 0]], ["a", "b"], np.array([[0.3, 0.2, 0.1], [0.3, 0.201, 0.1]]))


def test_parts_that_drift_off_the_hinge_are_brought_back_and_the_residual_is_kept(tmp_path):
    """The door is tracked 6 mm off its hinge, so the residual is 3 mm for each part."""
    hinge = Hinge(np.array([0, 0, 1.0]), np.zeros(3))
    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    angle = np.linspace(0, 4, 9)
    base = transforms(Rotation.from_rotvec(np.linspace([0, 0, 0], [0.2, 0.5, 0], 9)), np.zeros((9, 3)))
    rotated = base @ transforms(Rotation.from_rotvec(np.outer(angle, hinge.axis)), np.zeros((9, 3)))
    off = rotated.copy()
    off[:, :3, 3] += 0.006 * base[:, :3, 2]
    exact, drifted = (fit_hinge(base, moving, hinge, (corners, corners)) for moving in (rotated, off))
    assert exact.residual_m.max() < 1e-9
    assert np.abs(exact.hinge_rad - angle).max() < 1e-9
    assert drifted.residual_m == pytest.approx(np.full(9, 0.003), abs=1e-6)
    assert np.abs(drifted.hinge_rad - angle).max() < 1e-6
    twisted = base @ transforms(
        Rotation.from_rotvec(np.outer(angle, hinge.axis)) * Rotation.from_rotvec([0.05, 0, 0]), np.zeros((9, 3))
    )
    assert np.rad2deg(fit_hinge(base, twisted, hinge, (corners, corners)).residual_rad).max() > 1


def test_frames_far_off_the_hinge_are_excluded_with_the_reason(tmp_path):
    write_recording(tmp_path, recording(SAFE, 5))
    path = tmp_path / ANNOTATIONS / SAFE / "objpose/19.json"
    value = json.loads(path.read_text())
    next(entry for entry in value["dataList"] if entry["label"] == "Safedoor")["center"]["x"] += 0.1
    path.write_text(json.dumps(value))
    result = load(tmp_path, SAFE, clips="whole")
    assert the_clip(result).source_frames[-1] == 18
    (reason,) = (item for item in result if isinstance(item, Quarantined))
    assert (reason.source_key, "1 frames, the first 19" in reason.got) == (f"hoi4d/{SAFE}/hinge", True)
    assert "; hinge: " in the_clip(result).gravity_note


def test_drawers_and_further_parts_are_refused():
    node = {"parent": -1, "parts": [{"id": 5}], "jointData": {}}
    for joints in (("自由", "滑动"), ("自由", "铰链（旋转）", "铰链（旋转）"), ("自由",)):
        nodes = [{**node, "id": number, "joint": joint} for number, joint in enumerate(joints)]
        with pytest.raises(BadInput, match="no drawers"):
            hinge_joint(json.dumps(nodes).encode(), b"[]", "mobility_v2.json", "result.json")


# --- events and names


@pytest.mark.parametrize(
    ("value", "frames"),
    [
        ({"info": {"duration": 20.0}, "events": [{"event": "cut", "startTime": 1, "endTime": 4}]}, (15, 60)),
        ({"info": {"duration": 10.0}, "events": [{"event": "cut", "startTime": 1, "endTime": 4}]}, (30, 120)),
        ({"info": {}, "events": [{"event": "cut", "startTime": 1, "endTime": 10.1}]}, (30, 303)),
        ({"info": {}, "events": [{"event": "cut", "startTime": 1, "endTime": 19.9}]}, (15, 298)),
        (
            {"info": {"Duration": 20}, "markResult": {"marks": [{"event": "cut", "hdTimeStart": 1, "hdTimeEnd": 4}]}},
            (15, 60),
        ),
    ],
)
def test_the_clock_of_an_action_file_is_that_of_300_frames(value, frames):
    (event,) = action_events(json.dumps(value).encode(), "color.json")
    assert (event.start, event.stop) == frames


def test_frames_have_one_file_each_padded_or_not():
    assert frame_numbers("x", ["0.json", "00001.json"]) == {0: "0.json", 1: "00001.json"}
    for names, says in ((["1.json", "00001.json"], "one file per frame"), (["a.json"], "frame number")):
        with pytest.raises(BadInput, match=says):
            frame_numbers("x", names)


def test_gravity_is_estimated_where_a_mug_stands_on_two_of_its_sides(tmp_path):
    """The object rests, is lifted, rotated onto its side and rests again; the hands leave it."""
    n_frames = 50
    fraction = np.clip((np.arange(n_frames) - 18) / 12, 0, 1)
    rotation = Rotation.from_rotvec(np.outer(fraction * np.pi / 2, [1.0, 0, 0]))
    height = 0.06 - 0.01 * fraction + 0.15 * np.sin(np.pi * fraction)
    position_m = np.stack([np.full(n_frames, 0.1), 0.5 + 0.1 * fraction, height], axis=1)
    written = recording(MUG, 2, n_frames)
    near = ((fraction > 0) & (fraction < 1))[:, None]
    wrist = np.where(near, position_m + np.array([0, 0, 0.12]), (0.8, 0.5, 0.3))
    waits = {side: (o, f, wrist, b) for side, (o, f, _, b) in written.hands.items()}
    still = np.tile(written.camera[:1], (n_frames, 1, 1))
    plain = (Rotation.identity(), Rotation.identity())
    written = replace(written, pose=transforms(rotation, position_m), hands=waits, box_rotations=plain, camera=still)
    write_recording(tmp_path, written)
    clip = the_clip(load(tmp_path, MUG, clips="whole"))
    assert clip.gravity is not None, clip.gravity_note
    assert clip.gravity @ [0, 0, -1] > np.cos(np.deg2rad(1))
    assert clip.gravity_note.startswith("estimated from")


def test_cams_lists_are_a_split_of_twenty_recordings():
    rule = definitions_for("hoi4d")["cams"].rule
    assert (len(rule.train), len(rule.test)) == (14, 6)
    kinds = {name.split("/")[2] + name.split("/")[-1] for name in (*rule.train, *rule.test)}
    assert kinds == {"C9T2", "C11T4"}


def test_a_mesh_that_is_not_a_rigidly_moved_copy_is_refused(tmp_path):
    written = recording(SAFE, 6)
    write_recording(tmp_path, written)
    path = tmp_path / MODELS / "articulated/Safe/004/objs/new-1-align.obj"
    path.write_text(path.read_text().replace("v ", "v 9", 1).replace("v 9-", "v -9", 1))
    with pytest.raises(BadInput, match="the same mesh, turned and moved"):
        load(tmp_path, SAFE)
