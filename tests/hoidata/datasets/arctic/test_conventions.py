"""ARCTIC's conventions, one test each: literal numbers, formulas of the publication, and the same with the flipped
convention, which must be off by more than 5 mm (or by a frame). The formulas use neither a builder nor hoidata's code.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.hand_parameters import hands_for
from hoidata.datasets import RawTree
from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.hands import HandPair, load_embedded_hands
from tests.builders import arctic as recording
from tests.builders.arctic import BOTTOM_MM, SHAPE, STORED, TOP_MM
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, chain, joints_as_stored, off_m, rest_points
from tests.hoidata.datasets.contract import SeatedPersonContract

AT = 30  # the tested frame
ANGLE, OBJECT_ORIENT, OBJECT_MM = (array[AT] for array in (recording.ANGLE, recording.ORIENT, recording.TRANSLATION_MM))
ORIENT, TRANS = recording.HAND_ORIENT, recording.HAND_TRANSL
HEAD = recording.head()
HEAD_TURN, HEAD_SHIFT_M = Rotation.from_matrix(HEAD["R_k_cam_np"][AT]), HEAD["T_k_cam_np"][AT, :, 0]  # world to camera


def write(root: Path, description: str = "21-45 open, right hand\n", egocam: bool = True) -> Path:
    recording.write_root(root)
    recording.write_sequence(root, lines=description)
    if egocam:
        recording.write_extra(root, "egocam.dist", HEAD)
    return root


@pytest.fixture
def clip(tmp_path, load_all):
    (clip,) = load_all(ArcticAdapter(), write(tmp_path))
    return clip


def at(clip) -> int:
    return clip.source_frames.tolist().index(AT)


def absolute(hands, side: str) -> np.ndarray:
    return np.array(STORED) + hands[side].mean_pose


def hand_joints(clip, side: str, hands) -> np.ndarray:
    """(16, 3) joints of the tested frame, from the clip."""
    return joints_as_stored(clip.hands[side], hands[side], at(clip))


def arctic_joints(side: str, hands, bends=None, betas=None) -> np.ndarray:
    """(16, 3) joints by ARCTIC's convention: betas, angles plus mean pose, rotated about J0, then translated."""
    rest = rest_points(hands[side], SHAPE[side] if betas is None else betas)
    return chain(rest, ORIENT[side], absolute(hands, side) if bends is None else bends, TRANS[side])


@pytest.mark.parametrize("side", ["left", "right"])
class TestHands:
    def test_fingers_are_relative_to_the_mean_pose(self, clip, hands, side):
        meant = Rotation.from_rotvec(absolute(hands, side).reshape(15, 3)).as_rotvec()  # of at most pi, as in the store
        np.testing.assert_allclose(clip.hands[side].hand_pose[at(clip)], meant.ravel(), atol=EXACT_M)
        actual = hand_joints(clip, side, hands)
        agrees(actual, arctic_joints(side, hands), arctic_joints(side, hands, bends=np.array(STORED)))

    def test_angles_beyond_pi_gain_the_mean_as_they_are(self, clip, hands, side):
        actual = hand_joints(clip, side, hands)
        wrapped = Rotation.from_rotvec(np.reshape(STORED, (15, 3))).as_rotvec().ravel()
        assert np.abs(wrapped - STORED).max() > 1
        agrees(actual, arctic_joints(side, hands), arctic_joints(side, hands, bends=wrapped + hands[side].mean_pose))

    def test_the_hand_rotates_about_its_shaped_rest_wrist_and_is_moved_by_trans(self, clip, hands, side):
        rest = rest_points(hands[side], SHAPE[side])
        actual = hand_joints(clip, side, hands)
        assert off_m(clip.hands[side].wrist_m[at(clip)], rest[0] + TRANS[side]) < EXACT_M
        assert off_m(actual, arctic_joints(side, hands) - rest[0]) > WRONG_M
        about_origin = Rotation.from_rotvec(ORIENT[side]).apply(rest[0]) + TRANS[side]
        assert off_m(clip.hands[side].wrist_m[at(clip)], about_origin) > WRONG_M

    def test_one_row_of_betas_holds_for_the_whole_sequence(self, clip, hands, side):
        np.testing.assert_allclose(clip.hands[side].betas, [SHAPE[side]], atol=EXACT_M)
        actual = hand_joints(clip, side, hands)
        agrees(actual, arctic_joints(side, hands), arctic_joints(side, hands, betas=np.zeros(10)))


def test_left_betas_belong_to_the_shape_directions_as_mano_released_them(tmp_path):
    """A pair like MANO's: x of the left shape directions has the right hand's sign."""
    hands = load_embedded_hands()
    right_directions = hands.right.shape_directions.copy()
    right_directions[:, 0, 0] += 0.003  # one beta that also moves the wrist
    left_directions = hands.left.shape_directions.copy()
    left_directions[:, 0] = right_directions[:, 0]
    released = HandPair(
        left=replace(hands.left, shape_directions=left_directions),
        right=replace(hands.right, shape_directions=right_directions),
    )
    mended = left_directions.copy()
    mended[:, 0] *= -1
    adapter, raw = ArcticAdapter(), RawTree(write(tmp_path))
    used = hands_for(adapter.hand_convention, released)
    (clip,) = adapter.load(raw, adapter.sequences(raw.root)[0], used)
    actual = hand_joints(clip, "left", used)
    corrected = replace(released, left=replace(released.left, shape_directions=mended))
    agrees(actual, arctic_joints("left", released), arctic_joints("left", corrected))


def canonical_mm(angle: float, moving: tuple[int, ...] = (4, 5, 6, 7)) -> np.ndarray:
    """The template with the moving vertices rotated about (0, 0, -1): Rz(-angle)."""
    points = np.array(BOTTOM_MM + TOP_MM)
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    points[list(moving)] = points[list(moving)] @ rotation.T
    return points


def in_world_m(points_mm: np.ndarray) -> np.ndarray:
    return (Rotation.from_rotvec(OBJECT_ORIENT).apply(points_mm) + OBJECT_MM) / 1000


def clip_points(clip) -> np.ndarray:
    """World points of the object from the clip: part 1 rotated by R(axis * angle) about the hinge origin."""
    model, track, frame = clip.object.model, clip.object, at(clip)
    rotation = Rotation.from_rotvec(np.array(model.hinge.axis) * track.hinge_rad[frame])
    moved = rotation.apply(model.vertices_m - model.hinge.origin_m) + model.hinge.origin_m
    local = np.where(model.part[:, None] == 1, moved, model.vertices_m)
    return Rotation.from_rotvec(track.rotvec[frame]).apply(local) + track.translation_m[frame]


class TestObject:
    def test_the_mesh_is_in_millimetres(self, clip):
        agrees(clip.object.model.vertices_m, np.array(BOTTOM_MM + TOP_MM) / 1000, np.array(BOTTOM_MM + TOP_MM))

    def test_the_translation_is_in_millimetres(self, clip):
        agrees(clip.object.translation_m[at(clip)], np.array(OBJECT_MM) / 1000, OBJECT_MM)

    def test_hands_are_in_metres_all_the_same(self, clip, hands):
        rest = rest_points(hands.left, SHAPE["left"])
        assert off_m(clip.hands["left"].wrist_m[at(clip)], rest[0] + np.array(TRANS["left"]) / 1000) > WRONG_M

    def test_it_rotates_column_vectors(self, clip):
        actual = clip_points(clip)
        as_rows = (canonical_mm(ANGLE) @ Rotation.from_rotvec(OBJECT_ORIENT).as_matrix() + OBJECT_MM) / 1000
        agrees(actual, in_world_m(canonical_mm(ANGLE)), as_rows)

    def test_part_0_of_the_file_is_the_top_and_moves(self, clip):
        actual = clip_points(clip)
        agrees(actual, in_world_m(canonical_mm(ANGLE)), in_world_m(canonical_mm(ANGLE, moving=(0, 1, 2, 3))))
        assert clip.object.model.part.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]

    def test_the_hinge_rotates_about_minus_z(self, clip):
        actual = clip_points(clip)
        agrees(actual, in_world_m(canonical_mm(ANGLE)), in_world_m(canonical_mm(-ANGLE)))

    def test_hinge_angles_are_not_wrapped(self, clip):
        np.testing.assert_allclose(clip.object.hinge_rad, recording.ANGLE[clip.source_frames], atol=EXACT_M)
        assert abs(clip.object.hinge_rad[at(clip)] - (ANGLE - 2 * np.pi)) > 6


@pytest.mark.parametrize(
    ("described", "first", "last"), [("21-45", 20, 44), ("1-20", 0, 19), ("31-50", 30, 49), ("1-50", 0, 49)]
)
def test_ranges_count_from_one_and_include_both_ends(tmp_path, load_all, described, first, last):
    (clip,) = load_all(ArcticAdapter(), write(tmp_path, f"{described} open, right hand\n"))
    assert clip.source_frames.tolist() == list(range(first, last + 1))
    start, stop = map(int, described.split("-"))
    assert clip.source_frames.tolist() not in (list(range(start, stop + 1)), list(range(start - 1, stop - 1)))


class TestHeadCamera:
    POINT_M = np.array((0.35, -0.6, 1.2))

    def test_the_file_takes_the_world_to_the_camera_and_the_clip_the_camera_to_the_world(self, clip):
        camera = clip.camera
        point_camera = HEAD_TURN.apply(self.POINT_M) + HEAD_SHIFT_M
        rotation, position_m = Rotation.from_rotvec(camera.rotvec[at(clip)]), camera.position_m[at(clip)]
        the_other_way = HEAD_TURN.apply(point_camera) + HEAD_SHIFT_M
        agrees(rotation.apply(point_camera) + position_m, self.POINT_M, the_other_way)
        assert off_m(position_m, HEAD_SHIFT_M) > WRONG_M

    def test_intrinsics_are_focal_lengths_centre_and_size_of_the_image(self, clip):
        assert clip.camera.name == "ego"
        assert clip.camera.intrinsics.tolist() == [1500.0, 1510.0, 1400.0, 1000.0, 2800.0, 2000.0]

    def test_images_are_numbered_like_frames_where_nothing_else_is_said(self, clip):
        assert clip.camera.images.tolist() == clip.source_frames.tolist()

    def test_images_are_numbered_later_by_the_subjects_offset(self, tmp_path, load_all):
        root = write(tmp_path)
        offsets = {"s04": {"ioi_offset": 7}, "s01": {"ioi_offset": 3}}
        (root / "meta" / "misc.json").write_text(json.dumps(offsets))
        (clip,) = load_all(ArcticAdapter(), root)
        assert clip.camera.images.tolist() == [frame + 7 for frame in clip.source_frames.tolist()]
        assert "meta/misc.json" in {source.path for source in clip.sources}

    def test_a_sequence_without_its_file_has_no_camera(self, tmp_path, load_all):
        (clip,) = load_all(ArcticAdapter(), write(tmp_path, egocam=False))
        assert clip.camera is None


def test_things_fall_along_minus_z(clip):
    assert clip.gravity.tolist() == [0.0, 0.0, -1.0]


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, tmp_path, hands, load_all):
        """Joints of both hands and three edges of the box in the world, of a person of known pose."""

        def of(person):
            root = write(tmp_path)
            edges_mm = np.array([[-100.0, 0.0, 0.0], [0.0, 80.0, 0.0], [0.0, 0.0, 50.0]]) * person.signs
            corners = np.concatenate((np.zeros((1, 3)), edges_mm, np.array(TOP_MM) * person.signs))
            lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["f 1 2 3", "f 1 3 4", "f 5 6 7", "f 5 7 8"]
            (root / "meta/object_vtemplates/box/mesh.obj").write_text("\n".join(lines))
            blocks = {}
            for side, (orient, angles, transl) in person.hands.items():
                rows = {"rot": orient, "pose": angles, "trans": transl}
                blocks[side] = recording.hand_params(side) | {
                    name: np.tile(np.float32(row), (recording.N_FRAMES, 1)) for name, row in rows.items()
                }
            np.save(root / "raw_seqs/s04/box_grab_01.mano.npy", np.array(blocks, dtype=object))
            box = (0.0, *person.object_orient, *(OBJECT_MM * person.signs))
            np.save(root / "raw_seqs/s04/box_grab_01.object.npy", np.tile(box, (recording.N_FRAMES, 1)))
            (clip,) = load_all(ArcticAdapter(), root)
            points = clip_points(clip)
            return {side: hand_joints(clip, side, hands) for side in ("left", "right")}, points[1:4] - points[0]

        return of
