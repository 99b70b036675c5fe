"""OakInk2's adapter on recordings written from a ground truth, with objects of several parts."""

import json
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.annotation.sentences import english_sentences
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.validation import check_clip
from hoidata.datasets import RawTree
from hoidata.datasets.hinge import find_hinge, hinge_between
from hoidata.datasets.oakink2.adapter import Oakink2Adapter
from hoidata.datasets.oakink2.files import _VERBS, read_names, read_program, read_roots
from hoidata.errors import BadInput
from tests.builders.hoi4d import transforms
from tests.builders.oakink2 import (
    AXIS,
    BASE,
    BODY,
    BOTTLE,
    CAP,
    CUP,
    FIRST,
    HANDS,
    LAPTOP,
    LID,
    MUG,
    ORIGIN,
    Recording,
    key_of,
    recording,
    write_json,
    write_recording,
    write_three,
)


def load(root, name, **settings) -> list[Clip | Quarantined]:
    return Oakink2Adapter(**settings).load(RawTree(root), key_of(name), HANDS)


def the_clip(results, verb: str) -> Clip:
    (clip,) = (item for item in results if isinstance(item, Clip) and item.verb == verb)
    return check_clip(clip)


def reasons(results) -> list[Quarantined]:
    return [item for item in results if isinstance(item, Quarantined)]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_three(tmp_path_factory.mktemp("oakink2"))


def off_truth_m(clip: Clip, made: Recording, ids: tuple[tuple[str, ...], ...]) -> float:
    """Largest distance of any object vertex of a clip from its ground truth position."""
    rows, off = clip.source_frames - FIRST, []
    for track, names in zip((clip.object, *clip.other_objects), ids, strict=True):
        result = track.points_in_world(track.model.vertices_m, track.model.part)
        for part, name in enumerate(names):
            mesh, poses = made.parts[name]
            truth = mesh.vertices @ poses[rows, :3, :3].transpose(0, 2, 1) + poses[rows, None, :3, 3]
            off.append(np.abs(result[:, track.model.part == part] - truth).max())
    return max(off)


def test_recordings_come_back_to_their_truth_in_the_world(root):
    expected_ids = {
        (LAPTOP, "open"): ((BASE, LID),),
        (LAPTOP, "rearrange"): ((MUG,), (BASE, LID)),
        (BOTTLE, "unscrew"): ((CAP,), (BODY,)),
        (CUP, "pour"): ((MUG,),),
    }
    for (name, verb), ids in expected_ids.items():
        truth, clip = recording(name, [LAPTOP, BOTTLE, CUP].index(name)), the_clip(load(root, name), verb)
        assert off_truth_m(clip, truth, ids) < 1e-4
        rows = clip.source_frames - FIRST
        for side in SIDES:
            orient, fingers, wrist, betas = truth.hands[side]
            track = clip.hands[side]
            assert track.valid.all()
            assert np.abs(track.wrist_m - wrist[rows]).max() < 1e-4
            off = Rotation.from_rotvec(track.global_orient).inv() * Rotation.from_rotvec(orient[rows])
            assert np.rad2deg(off.magnitude()).max() < 0.01
            assert np.abs(track.hand_pose - fingers).max() < 1e-5
            assert np.abs(track.betas - betas).max() < 1e-6


def test_two_parts_that_rotate_about_one_axis_are_one_object_with_a_hinge(root):
    track = the_clip(load(root, LAPTOP), "open").object
    assert np.abs(track.model.hinge.axis - AXIS).max() < 1e-6
    off_axis = np.cross(track.model.hinge.origin_m - ORIGIN, AXIS)
    assert np.abs(off_axis).max() < 1e-6
    assert np.abs(track.hinge_rad - (0.2 + 1.5 * np.linspace(0, 1, 81)[::4] ** 2)).max() < 1e-5
    assert track.model.name == "O02@0061"


def test_a_clip_has_the_words_hand_and_objects_of_its_primitive_and_others_are_listed_with_their_reason(root):
    results = load(root, BOTTLE)
    clip = the_clip(results, "unscrew")
    assert (clip.object_words, clip.labelled_hand, clip.subject) == ("bottle cap", "both", "A004")
    assert clip.clip_id == f"oakink2/{BOTTLE}/left-6-87-right-10-87"
    assert [track.model.name for track in (clip.object, *clip.other_objects)] == [CAP, BODY]
    result = {item.source_key.rpartition("/")[2]: (item.expected, item.got) for item in reasons(results)}
    assert result == {
        "left-46-66": ("20 frames (at 30 per second) with the objects", "5 in mocap frames 46 to 65"),
        "right-6-87": ("a primitive with a name", "'?(unk)'"),
        "right-8-87": ("poses of an object of the primitive", "none of O02@0099@00001"),
    }
    wide = the_clip(load(root, BOTTLE, shortest_frames=5, margin_frames=3), "hold")
    assert (wide.source_frames[0], wide.source_frames[-1], wide.object_words) == (34, 74, "bottle")
    opened = the_clip(load(root, LAPTOP), "open")
    assert (opened.object_words, opened.labelled_hand, opened.source_frames[0]) == ("laptop", "both", 6)


def test_an_object_without_a_name_makes_no_clip(root, tmp_path):
    write_recording(tmp_path, recording(CUP, 2))
    write_json(tmp_path / "object_repair/obj_desc.json", {MUG: {"obj_id": MUG, "obj_name": " "}})
    (reason,) = reasons(load(tmp_path, CUP))
    assert (reason.expected, reason.got) == ("a name of the object in obj_desc.json", f"none of {MUG}")


def test_parts_whose_meshes_share_no_frame_rest_as_they_first_lie(tmp_path):
    """The lid's mesh has another frame, so no hinge fits the pose of the meshes."""
    truth = recording(LAPTOP, 3)
    lid_from_mesh = transforms(Rotation.from_rotvec([[1.0, 0.4, -0.7]]), [[0.3, 0.1, 0.2]])[0]
    mesh, poses = truth.parts[LID]
    moved = mesh.copy().apply_transform(np.linalg.inv(lid_from_mesh))
    truth = replace(truth, parts={**truth.parts, LID: (moved, poses @ lid_from_mesh)})
    clip = the_clip(load(write_recording(tmp_path, truth), LAPTOP), "open")
    assert off_truth_m(clip, truth, ((BASE, LID),)) < 1e-4
    assert clip.object.hinge_rad[0] == pytest.approx(0, abs=1e-6)
    assert clip.object.hinge_rad[-1] == pytest.approx(1.5, abs=1e-4)


@pytest.mark.slow
def test_frames_off_the_hinge_or_untracked_divide_a_clip_and_parts_mostly_off_it_stay_two_objects(tmp_path):
    truth = recording(LAPTOP, 4, 401)
    lid, poses = truth.parts[LID]
    poses = poses.copy()
    poses[76:92, :3, 3] += 0.1
    program = (((FIRST, FIRST + 401), None, "open_laptop_lid", "lh_main", [LID], None),)
    truth = replace(truth, parts={**truth.parts, LID: (lid, poses)}, program=program, untracked={BASE: (FIRST + 120,)})
    results = load(write_recording(tmp_path / "few", truth), LAPTOP, shortest_frames=5)
    clips = [item for item in results if isinstance(item, Clip)]
    spans = [(int(clip.source_frames[0]), int(clip.source_frames[-1])) for clip in clips]
    assert spans == [(6, 78), (98, 406)]
    assert [clip.clip_id.rpartition("/")[2] for clip in clips] == ["000006", "000098"]
    missing, reason = reasons(results)
    assert missing.got == "none in source frames 82 to 94"
    assert reason.source_key == f"oakink2/{LAPTOP}/hinge of O02@0061"
    assert "4 frames, the first 82" in reason.got
    # The single frame without a base is interpolated.
    assert clips[1].source_frames[[6, 7, 8, 9]].tolist() == [122, 122, 130, 134]
    assert np.flatnonzero(~clips[1].recorded).tolist() == [7]
    hinge = clips[1].object.hinge_rad
    assert hinge[7] == pytest.approx((hinge[6] + hinge[8]) / 2, abs=0.01)
    assert all("O02@0061: hinge: " in clip.gravity_note for clip in clips)
    poses[:100, 2, 3] += 0.1
    (alone, *_) = load(write_recording(tmp_path / "most", truth), LAPTOP, shortest_frames=5)
    assert isinstance(alone, Clip)
    assert (alone.object.model.name, alone.object.is_articulated, alone.object_words) == (LID, False, "laptop lid")


def test_a_hinge_is_found_despite_noise_and_outliers_and_none_in_a_screw_or_a_small_rotation():
    random, angle = np.random.default_rng(0), np.linspace(0, 1, 200)
    rotation = Rotation.from_rotvec(np.outer(angle, AXIS))
    exact = transforms(rotation, ORIGIN - rotation.apply(ORIGIN))
    base = transforms(Rotation.random(200, rng=1), random.normal(0, 1, (200, 3)))
    corners = (0.2 * random.normal(0, 1, (8, 3)), 0.2 * random.normal(0, 1, (8, 3)))
    noisy = exact @ transforms(
        Rotation.from_rotvec(random.normal(0, 0.005, (200, 3))), random.normal(0, 1e-3, (200, 3))
    )
    noisy[[5, 60], :3, 3] += 0.3
    hinge, fit = hinge_between(base, noisy, corners, 20, 10)
    assert np.rad2deg(np.arccos(hinge.axis @ AXIS)) < 0.5
    assert np.linalg.norm(np.cross(hinge.origin_m - ORIGIN, AXIS)) < 2e-3
    assert np.flatnonzero(fit.exceeds(20, 10)).tolist() == [5, 60]
    screw = exact.copy()
    screw[:, :3, 3] += np.outer(angle, 0.2 * AXIS)
    assert hinge_between(base, screw, corners, 20, 10) is None
    assert find_hinge(exact[:30]) is None
    opposite = transforms(rotation.inv(), ORIGIN - rotation.inv().apply(ORIGIN))
    assert find_hinge(opposite).axis == pytest.approx(AXIS)


LISTS = b'"obj_list": ["a"], "obj_list_lh": ["b"], "obj_list_rh": []'
STIR = b'{"primitive": "stir", "interaction_mode": "bh_main", %s}' % LISTS
NO_KEYS = (
    *(b"(None, None)", b"((9, 5), None)", b"((1, 2), (3,))", b"(1.5, None)", b"((True, 2), None)", b"(" * 90, b""),
    *(b"__import__('os')", b"((1, 2), None" + b" " * 100 + b")", b"((1, 99999999), None)"),
)


@pytest.mark.parametrize(
    ("key", "span", "hand", "name"),
    [
        ("((1595, 2340), None)", (1595, 2340), "left", "left-1595-2340"),
        ("(None, (966, 5954))", (966, 5954), "right", "right-966-5954"),
        ("((9, 20), (3, 12))", (3, 20), "both", "left-9-20-right-3-12"),
        (" [[9, 20],[3, 12] ]", (3, 20), "both", "left-9-20-right-3-12"),
    ],
)
def test_keys_of_a_program_are_the_ranges_of_both_hands(key, span, hand, name):
    (segment,) = read_program(b'{"%s": %s}' % (key.encode(), STIR), "x.json")
    assert (segment.span, segment.hand, segment.name, segment.objects) == (span, hand, name, ("b", "a"))


@pytest.mark.parametrize(
    ("read", "data", "says"),
    [
        *((read_program, b'{"%s": %s}' % (key, STIR), "a range of frames of each hand") for key in NO_KEYS),
        (read_program, b"[1]", "a dictionary of primitives"),
        (read_program, b"[" * 100_000, "JSON"),
        (read_program, b'{"(None, (1, 2))": %s}' % STIR.replace(b"bh_main", b"foot"), "a mode of"),
        (read_names, b"[1]", "objects by id"),
        (read_names, b'{"a": {"obj_name": 1}}', "a name in words"),
        (read_roots, b"[1]", "lists of part ids"),
        (read_roots, b'{"a": ["b"], "b": ["a"]}', "below itself"),
    ],
)
def test_a_json_file_of_another_form_is_refused(read, data, says):
    with pytest.raises(BadInput, match=says) as caught:
        read(data, "x.json")
    assert caught.value.where.startswith("x.json")


@pytest.mark.slow
def test_its_words_make_sentences():
    for verb in _VERBS.values():
        assert verb.split()[0] in english_sentences(verb, "alcohol burner", "right")[0].lower()


def test_a_tree_of_parts_as_deep_as_its_file_allows_is_read_in_less_than_two_seconds():
    """Searching the root of each part separately takes quadratic time: minutes for a megabyte."""
    names = [f"{number:06d}" for number in range(60_000)]
    tree = {parent: [child] for child, parent in pairwise(names)}
    start = time.process_time()
    roots = read_roots(json.dumps(tree).encode(), "object_part_tree.json")
    assert time.process_time() - start < 2
    assert set(roots.values()) == {names[-1]}
    assert len(roots) == len(names) - 1
