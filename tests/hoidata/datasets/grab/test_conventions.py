"""GRAB's conventions, one test each: literal numbers, formulas of the publication, and the same with the flipped
convention, which must be off by more than 5 mm (or by a frame). The formulas use neither a builder nor hoidata's code.
"""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.datasets.grab.adapter import GrabAdapter
from tests.builders.formulas import EXACT_M, WRONG_M, agrees, chain, joints_as_stored, off_m, rest_points
from tests.hoidata.datasets.contract import SeatedPersonContract

N_FRAMES = 81  # 120 Hz; frames 0, 4, ..., 80 are those of 30 Hz
FIRST_TOUCH, LAST_TOUCH = 22, 56  # not a multiple of 4, and a multiple: the clip has 24 to 56
AT = 36  # the tested frame, the fourth of the clip
MUG_M = [[0.05, 0.0, -0.02], [0.0, 0.07, 0.0], [-0.05, 0.0, 0.03], [0.0, -0.04, 0.06], [0.02, 0.03, 0.09]]
MUG_FACES = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 3, 2], [0, 2, 1]]
TABLE_M = [[0.6, 0.4, 0.0], [-0.6, 0.4, 0.0], [-0.6, -0.4, 0.0], [0.6, -0.4, 0.0], [0.0, 0.0, -0.05]]
TABLE_FACES = [[0, 1, 2], [0, 2, 3], [0, 4, 1], [1, 4, 2], [2, 4, 3], [3, 4, 0]]
MUG_ORIENT, MUG_PLACE = (0.5, -0.8, 1.1), (0.31, -0.12, 0.87)
TABLE_ORIENT, TABLE_PLACE = (0.02, 0.01, 0.6), (0.1, -0.2, 0.72)
ORIENT = {"left": (0.9, -0.3, 1.4), "right": (-0.5, 1.7, 0.2)}
TRANSL = {"left": (0.24, 0.11, 0.93), "right": (-0.17, 0.05, 1.02)}
INDEX_BEND, THUMB_BEND = (0.1, -0.05, 0.7), (0.3, 0.2, -0.1)
WEIGHTS = [0.9, -1.1, 0.7, 0.4, -0.6, 0.2, 0.5, -0.3, 0.1, 0.8, -0.2, 0.3, 0.6, -0.4, 0.2, 0.1, -0.5, 0.3, 0.2, -0.1,
           0.4, 0.1, -0.2, 0.3]  # fmt: skip


def fingers() -> np.ndarray:
    """45 absolute angles: the first joint of the index, the second of the thumb."""
    angles = np.zeros(45)
    angles[0:3], angles[39:42] = INDEX_BEND, THUMB_BEND
    return angles


def every_frame(row) -> np.ndarray:
    return np.tile(np.asarray(row, np.float32), (N_FRAMES, 1))


def personal_mesh(hands, side: str) -> np.ndarray:
    """Hands 12 % longer than the model's and 4 cm from its origin, in different directions for left and right."""
    shift = {"left": (0.04, -0.01, 0.0), "right": (0.0, 0.03, -0.02)}[side]
    return np.float32(hands[side].template_m * 1.12 + shift).astype(np.float64)


def hand_block(side: str) -> dict:
    params = {"global_orient": every_frame(ORIENT[side]), "transl": every_frame(TRANSL[side])}
    params["fullpose"] = every_frame(fingers())
    return {"params": params, "vtemp": f"tools/subject_meshes/female/s8_{side[0]}hand.ply"}


def thing_block(name: str, orient, position_m) -> dict:
    return {"global_orient": every_frame(orient), "transl": every_frame(position_m)}


def recording() -> dict:
    contact = np.zeros((N_FRAMES, len(MUG_M)), np.int8)
    contact[FIRST_TOUCH : LAST_TOUCH + 1, 2] = 41
    contact[AT, 4] = 22
    meshes = "tools/object_meshes/contact_meshes"
    return {
        "gender": "female", "sbj_id": "s8", "obj_name": "mug", "motion_intent": "drink",
        "framerate": 120.0, "n_frames": N_FRAMES, "n_comps": 24,
        "lhand": hand_block("left"), "rhand": hand_block("right"),
        "object": {"params": thing_block("mug", MUG_ORIENT, MUG_PLACE), "object_mesh": f"{meshes}/mug.ply"},
        "table": {"params": thing_block("table", TABLE_ORIENT, TABLE_PLACE), "table_mesh": f"{meshes}/table.ply"},
        "contact": {"object": contact, "body": np.zeros((N_FRAMES, 5), np.int8)},
    }  # fmt: skip


def write(root: Path, data: dict) -> None:
    path = root / "grab" / "s8" / "mug_drink_2.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{key: np.array(value, object if isinstance(value, dict) else None) for key, value in data.items()})


@pytest.fixture
def root(tmp_path: Path, hands) -> Path:
    write(tmp_path, recording())
    meshes, people = tmp_path / "tools/object_meshes/contact_meshes", tmp_path / "tools/subject_meshes/female"
    meshes.mkdir(parents=True)
    people.mkdir(parents=True)
    trimesh.Trimesh(MUG_M, MUG_FACES, process=False).export(meshes / "mug.ply")
    trimesh.Trimesh(TABLE_M, TABLE_FACES, process=False).export(meshes / "table.ply")
    for side in ("left", "right"):
        mesh = trimesh.Trimesh(personal_mesh(hands, side), hands[side].faces, process=False)
        mesh.export(people / f"s8_{side[0]}hand.ply")
    return tmp_path


@pytest.fixture
def load(root, load_all):
    def changed(change=None):
        data = recording()
        if change is not None:
            change(data)
        write(root, data)
        (clip,) = load_all(GrabAdapter(), root)
        return clip

    return changed


def at(clip) -> int:
    return clip.source_frames.tolist().index(AT)


def placed(track, frame: int) -> np.ndarray:
    """World points of a column-vector track, by SciPy."""
    rotation = Rotation.from_rotvec(track.rotvec[frame])
    return rotation.apply(track.model.vertices_m) + track.translation_m[frame]


def hand_joints(clip, side: str, hands) -> np.ndarray:
    """(16, 3) joints of the tested frame, from the clip."""
    return joints_as_stored(clip.hands[side], hands[side], at(clip))


def grab_joints(side: str, hands, bends=None, mesh=None, orient=None) -> np.ndarray:
    """(16, 3) joints by GRAB's convention: the subject's mesh, absolute angles, rotated about J0, then translated."""
    rest = rest_points(hands[side], template_m=personal_mesh(hands, side) if mesh is None else mesh)
    return chain(rest, ORIENT[side], fingers() if bends is None else bends, TRANSL[side])


def row_vectors(points, orient, position_m) -> np.ndarray:
    return np.array(points) @ Rotation.from_rotvec(orient).as_matrix() + position_m


def test_objects_rotate_as_row_vectors(load):
    actual = placed(load().object, 3)
    as_columns = Rotation.from_rotvec(MUG_ORIENT).apply(MUG_M) + MUG_PLACE
    agrees(actual, row_vectors(MUG_M, MUG_ORIENT, MUG_PLACE), as_columns)


def test_objects_rotate_about_the_origin_of_their_mesh_not_its_centre(load):
    actual, middle = placed(load().object, 3), np.mean(MUG_M, axis=0)
    about_middle = row_vectors(np.array(MUG_M) - middle, MUG_ORIENT, MUG_PLACE) + middle
    agrees(actual, row_vectors(MUG_M, MUG_ORIENT, MUG_PLACE), about_middle)


def test_an_object_rotation_beyond_pi_is_stored_as_the_same_rotation_of_at_most_pi(load):
    """Row vectors: the stored rotation is the transpose of 5 rad about z, -(5 - 2 pi)."""
    clip = load(lambda data: data["object"]["params"].update(global_orient=np.tile((0.0, 0.0, 5.0), (N_FRAMES, 1))))
    np.testing.assert_allclose(clip.object.rotvec, [(0, 0, 2 * np.pi - 5.0)] * clip.n_frames, atol=EXACT_M)


def test_the_table_rotates_as_row_vectors(load):
    (table,) = load().other_objects
    assert table.model.name == "table"
    actual = placed(table, 3)
    as_columns = Rotation.from_rotvec(TABLE_ORIENT).apply(TABLE_M) + TABLE_PLACE
    agrees(actual, row_vectors(TABLE_M, TABLE_ORIENT, TABLE_PLACE), as_columns)


@pytest.mark.parametrize("side", ["left", "right"])
class TestHands:
    def test_fingers_are_absolute(self, load, hands, side):
        clip = load()
        np.testing.assert_allclose(clip.hands[side].hand_pose[at(clip)], fingers(), atol=EXACT_M)
        actual = hand_joints(clip, side, hands)
        with_mean = grab_joints(side, hands, bends=fingers() + hands[side].mean_pose)
        agrees(actual, grab_joints(side, hands), with_mean)

    @pytest.mark.parametrize("count", [1, 6, 24, 45])
    def test_components_are_weights_of_the_models_first_rows_without_the_mean(self, load, hands, side, count):
        weights = np.array((WEIGHTS * 2)[:count]) * (1.5 if count == 1 else 1)

        def only_components(data):
            params = data[f"{side[0]}hand"]["params"]
            del params["fullpose"]
            params["hand_pose"] = np.tile(weights, (N_FRAMES, 1))

        actual = hand_joints(load(only_components), side, hands)
        bends = sum(weight * row for weight, row in zip(weights, hands[side].components, strict=False))
        agrees(
            actual, grab_joints(side, hands, bends=bends), grab_joints(side, hands, bends=bends + hands[side].mean_pose)
        )
        columns = hands[side].components[:, :count] @ weights
        assert off_m(actual, grab_joints(side, hands, bends=columns)) > WRONG_M
        as_angles = np.concatenate((weights, np.zeros(45 - count)))
        assert off_m(actual, grab_joints(side, hands, bends=as_angles)) > WRONG_M

    def test_fullpose_wins_over_components(self, load, side):
        def both(data):
            data[f"{side[0]}hand"]["params"]["hand_pose"] = np.tile(WEIGHTS, (N_FRAMES, 1))

        clip = load(both)
        np.testing.assert_allclose(clip.hands[side].hand_pose[at(clip)], fingers(), atol=EXACT_M)

    def test_the_rest_mesh_is_that_of_the_subject_without_betas(self, load, hands, side):
        clip = load()
        np.testing.assert_allclose(clip.hands[side].template_m, personal_mesh(hands, side), atol=EXACT_M)
        assert clip.hands[side].betas.tolist() == [[0.0] * 10]
        actual = hand_joints(clip, side, hands)
        agrees(actual, grab_joints(side, hands), grab_joints(side, hands, mesh=hands[side].template_m))

    def test_the_hand_rotates_about_its_rest_wrist_and_is_moved_by_transl(self, load, hands, side):
        clip = load()
        rest = rest_points(hands[side], template_m=personal_mesh(hands, side))[:16]
        actual = hand_joints(clip, side, hands)
        assert off_m(clip.hands[side].wrist_m[at(clip)], rest[0] + TRANSL[side]) < EXACT_M
        wrist_at_transl = grab_joints(side, hands) - rest[0]
        assert off_m(actual, wrist_at_transl) > WRONG_M
        about_origin = Rotation.from_rotvec(ORIENT[side]).apply(rest[0]) + TRANSL[side]
        assert off_m(clip.hands[side].wrist_m[at(clip)], about_origin) > WRONG_M

    def test_hands_rotate_as_column_vectors_unlike_objects(self, load, hands, side):
        actual = hand_joints(load(), side, hands)
        rest = rest_points(hands[side], template_m=personal_mesh(hands, side))
        turned_back = chain(rest, -np.array(ORIENT[side]), fingers(), TRANSL[side])
        agrees(actual, grab_joints(side, hands), turned_back)


def test_meshes_and_places_are_metres(load):
    clip = load()
    assert off_m(clip.object.model.vertices_m, np.array(MUG_M)) < EXACT_M
    assert off_m(clip.object.translation_m[3], np.array(MUG_PLACE)) < EXACT_M
    assert off_m(clip.other_objects[0].model.vertices_m, np.array(TABLE_M)) < EXACT_M
    assert off_m(clip.object.model.vertices_m, np.array(MUG_M) / 1000) > WRONG_M


def test_every_fourth_frame_counts_from_the_first_of_the_file_and_both_ends_of_the_contact_stay(load):
    clip = load()
    assert clip.source_frames.tolist() == [24, 28, 32, 36, 40, 44, 48, 52, 56]
    from_first_touch = list(range(FIRST_TOUCH, LAST_TOUCH + 1, 4))
    half_open = clip.source_frames.tolist()[:-1]
    assert clip.source_frames.tolist() not in (from_first_touch, half_open)


@pytest.mark.parametrize(("fps", "step"), [(30.0, 1), (60, 2), (120.0, 4), (240, 8)])
def test_the_frame_rate_of_the_file_determines_how_many_frames_are_skipped(load, fps, step):
    clip = load(lambda data: data.update(framerate=fps))
    first = -(-FIRST_TOUCH // step) * step
    assert clip.source_frames.tolist() == list(range(first, LAST_TOUCH + 1, step))
    assert clip.source_fps == fps


def test_contact_labels_keep_frame_vertex_and_toucher(load):
    contact = load().source_contact
    actual = list(zip(contact.frame.tolist(), contact.vertex.tolist(), contact.label.tolist(), strict=True))
    assert actual == sorted([*((frame, 2, 41) for frame in range(9)), (3, 4, 22)])
    assert (contact.frame.dtype, contact.vertex.dtype, contact.label.dtype) == (np.int32, np.int32, np.uint8)


def test_things_fall_along_minus_z(load):
    assert load().gravity.tolist() == [0.0, 0.0, -1.0]


# Half a turn about z puts them to her right, towards her, and up.
MUG_EDGES = [[-0.1, 0.0, 0.0], [0.0, 0.08, 0.0], [0.0, 0.0, 0.05]]


class TestSeatedPerson(SeatedPersonContract):
    @pytest.fixture
    def look(self, root, hands, load_all):
        """Joints of both hands and the mug's three edges in the world, of a person of known pose."""

        def of(person):
            data = recording()
            for side, (orient, angles, transl) in person.hands.items():
                params = {"global_orient": orient, "transl": transl, "fullpose": angles}
                data[f"{side[0]}hand"]["params"] = {name: every_frame(row) for name, row in params.items()}
                data[f"{side[0]}hand"]["vtemp"] = f"tools/subject_meshes/female/s8_{person.named[side][0]}hand.ply"
            data["object"]["params"] = thing_block("mug", person.object_orient, np.array(MUG_PLACE) * person.signs)
            write(root, data)
            mesh = trimesh.Trimesh(
                [np.zeros(3), *(MUG_EDGES * person.signs), (0.02, 0.02, 0.02)], MUG_FACES, process=False
            )
            mesh.export(root / "tools/object_meshes/contact_meshes/mug.ply")
            (clip,) = load_all(GrabAdapter(), root)
            corners = placed(clip.object, at(clip))
            return {side: hand_joints(clip, side, hands) for side in ("left", "right")}, corners[1:4] - corners[0]

        return of
