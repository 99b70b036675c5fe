"""Readers of trajectory files, and the remedies for implausible ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES
from hoidata.errors import BadInput
from hoidata.geometry.motion import Motion
from hoidata.hands import load_embedded_hands
from hoidata.object_paths.trajectory_files import PARTS, Axes, parse_csv, parse_manipnet, read_trajectories
from hoidata.objects.user_mesh import UNITS_M
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.animate import at_rate, blend_ends, control_from_file, interpolated
from models.manipnet.control import Control
from models.manipnet.plausible import reading
from tests.builders.objects import box_model, model_of, notebook

HANDS = {side: mano_hand(load_embedded_hands(), side) for side in SIDES}
BOX = box_model((0.06, 0.06, 0.1))
FRAMES = 6
WORLD = Rotation.from_rotvec([-1.3, -0.6, 0.0])


def table(
    scale: float = 1.0, order: str = "wxyz", step: float = 1 / 30, away_m: float = 0.0, world: Rotation = WORLD
) -> str:
    """A CSV table of a right hand that grasps a moving box, with fingers and palm facing it."""
    wrist_from_canonical = HANDS["right"].wrist_from_canonical
    # Canonical x (fingers) to -y of the world, canonical z (back of the hand) to +z; the palm above the box.
    world_from_canonical = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    wrist = Rotation.from_matrix(world_from_canonical @ wrist_from_canonical.T)
    names = "time_s," + ",".join(f"{body}_{p}" for body in ("object", "right") for p in PARTS)
    lines = [names]
    for frame in range(FRAMES):
        object_m = np.array([0.01 * frame, 0, 0.5])
        wrist_m = object_m + np.array([0.0, 0.08 + away_m, 0.07])
        rotations = [Rotation.from_rotvec([0, 0, 0.02 * frame]), wrist]
        # The scene is rotated, so that quaternions with permuted components differ.
        object_m, wrist_m, rotations = (
            world.apply(object_m),
            world.apply(wrist_m),
            [world * rotation for rotation in rotations],
        )
        quaternions = [
            rotation.as_quat() if order == "xyzw" else rotation.as_quat()[[3, 0, 1, 2]] for rotation in rotations
        ]
        numbers = [frame * step, *object_m * scale, *quaternions[0], *wrist_m * scale, *quaternions[1]]
        lines.append(",".join(f"{number:.9g}" for number in numbers))
    return "\n".join(lines)


def checked_control(text: str, model=BOX, unit: str = "m", axes: Axes = "model"):
    return control_from_file(replace(parse_csv(text.encode(), "mine.csv", unit), axes=axes), model, HANDS)


def with_last_time(time_s: str) -> str:
    *lines, last = table().splitlines()
    return "\n".join([*lines, ",".join([time_s, *last.split(",")[1:]])])


def test_a_table_is_read_with_its_columns_in_any_order() -> None:
    trajectories = parse_csv(table().encode(), "mine.csv")
    np.testing.assert_allclose(trajectories.object_body.time_s, np.arange(FRAMES) / 30, atol=1e-8)
    np.testing.assert_allclose(trajectories.object_body.position_m[3], WORLD.apply([0.03, 0, 0.5]), atol=1e-8)
    rotmat = (WORLD * Rotation.from_rotvec([0, 0, 0.06])).as_matrix()
    np.testing.assert_allclose(trajectories.object_body.rotmats[3], rotmat, atol=1e-8)
    columns = np.array([line.split(",") for line in table().splitlines()])
    shuffled = "\n".join(",".join(row) for row in columns[:, np.random.default_rng(0).permutation(15)])
    from_shuffled = parse_csv(shuffled.encode(), "mine.csv")
    np.testing.assert_array_equal(from_shuffled.wrists["right"].rotmats, trajectories.wrists["right"].rotmats)
    assert checked_control(table()).active == ["right"]


@pytest.mark.parametrize("lost", [",nan", ","])
def test_frames_in_which_a_body_is_lost_are_left_out_and_long_gaps_are_refused(lost: str) -> None:
    head, *lines = table().splitlines()
    whole = checked_control(table()).control.at(np.arange(FRAMES) / 30)

    def without(body: str, frames: slice) -> str:
        first = 1 if body == "object" else 8
        table_cells = [line.split(",") for line in lines]
        for cells in table_cells[frames]:
            cells[first : first + 7] = lost.split(",")[1:] * 7
        return "\n".join([head, *map(",".join, table_cells)])

    for body in ("object", "right"):
        checked = checked_control(without(body, slice(2, 4)))
        assert checked.active == ["right"]
        control = checked.control.at(np.arange(FRAMES) / 30)
        np.testing.assert_allclose(control.wrists["right"].position_m, whole.wrists["right"].position_m, atol=1e-3)
        np.testing.assert_allclose(control.object_motion.rotmats, whole.object_motion.rotmats, atol=1e-3)
    with pytest.raises(BadInput, match="neither"):
        parse_csv(without("right", slice(None)).encode(), "mine.csv")
    lines = with_last_time("1.1").splitlines()[1:]
    for frames, words in ((slice(1, None), "right lost for 1.10 s; cut"), (slice(1, 5), "right lost for 1.10 s; cut")):
        with pytest.raises(BadInput, match=f"gaps of at most 1 s, got {words}"):
            parse_csv(without("right", frames).encode(), "mine.csv")


def test_semicolons_decimal_commas_tabs_and_other_columns_do_not_matter() -> None:
    expected = parse_csv(table().encode(), "mine.csv").wrists["right"].position_m
    with_comment = [f"{line},{'note' if number == 0 else 'ok'}" for number, line in enumerate(table().splitlines())]
    texts = [table().replace(",", ";").replace(".", ","), table().replace(",", "\t"), "\n".join(with_comment)]
    for text in texts:
        np.testing.assert_array_equal(parse_csv(text.encode(), "mine.csv").wrists["right"].position_m, expected)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("right_", "Right_", "object, left or right.*got Right_x"),
        ("\n0.0333", "\nsoon", "row 2, time_s: expected a number, got 'soon"),
        ("object_qz,", "object_qz,left_arm_x,", "object, left or right.*got left_arm_x"),
    ],
)
def test_a_mistake_in_a_table_is_named_with_its_row_and_column(old: str, new: str, words: str) -> None:
    both = "\n".join(line + "," + ",".join(line.split(",")[-7:]) for line in table().splitlines())
    head, rest = both.split("\n", 1)
    names = head.split(",")
    text = "\n".join([",".join([*names[:15], *(name.replace("right", "left") for name in names[15:])]), rest])
    with pytest.raises(BadInput, match=words):
        parse_csv(text.replace(old, new).encode(), "mine.csv")


def test_an_infinite_number_is_named_with_its_row() -> None:
    lines = [line.split(",") for line in table().splitlines()]
    lines[2][1:8], lines[-1][1] = [""] * 7, "inf"  # the object is lost in row 2
    text = "\n".join(map(",".join, lines))
    with pytest.raises(BadInput, match=rf"object_position: expected finite .* got \[ *inf .*in row {FRAMES}"):
        parse_csv(text.encode(), "mine.csv")


def test_a_body_that_jumps_to_zero_is_lost_and_one_that_rests_there_is_not() -> None:
    lines = [line.split(",") for line in table().splitlines()]
    for cells in lines[3:5]:
        cells[8:15] = ["0", "0", "0", "1", "0", "0", "0"]
    jumping = parse_csv("\n".join(map(",".join, lines)).encode(), "mine.csv")
    assert len(jumping.wrists["right"].time_s) == FRAMES - 2
    for cells in lines[1:]:
        cells[1:8] = ["0", "0", "0", "1", "0", "0", "0"]
    resting = parse_csv("\n".join(map(",".join, lines)).encode(), "mine.csv")
    assert len(resting.object_body.time_s) == FRAMES


def test_npz_and_csv_give_the_same_trajectories_in_metres(tmp_path: Path) -> None:
    from_csv = parse_csv(table().encode(), "mine.csv")
    quaternion = Rotation.from_matrix(from_csv.wrists["right"].rotmats).as_quat()[:, [3, 0, 1, 2]]
    object_quaternion = Rotation.from_matrix(from_csv.object_body.rotmats).as_quat()[:, [3, 0, 1, 2]]
    np.savez(
        tmp_path / "mine.npz",
        time_s=from_csv.object_body.time_s,
        object_position=1000 * from_csv.object_body.position_m,
        object_quaternion=object_quaternion,
        right_position=1000 * from_csv.wrists["right"].position_m,
        right_quaternion=quaternion,
    )
    from_npz = read_trajectories(tmp_path / "mine.npz", "mm")
    np.testing.assert_allclose(from_npz.wrists["right"].position_m, from_csv.wrists["right"].position_m, atol=1e-12)
    np.testing.assert_allclose(from_npz.object_body.rotmats, from_csv.object_body.rotmats, atol=1e-9)


def test_manipnets_text_is_mirrored_and_converted_to_metres_at_the_box_centre() -> None:
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.5])
    row = ",".join(map(str, [*rotation.as_quat(), 1.0, 2.0, 3.0]))
    trajectories = parse_manipnet("\n".join(["120", *[",".join([row, row, row])] * 4]).encode(), "demo.txt")
    flip = np.diag([-1.0, 1, 1])
    np.testing.assert_allclose(trajectories.object_body.position_m[0], [-0.1, 0.2, 0.3])
    np.testing.assert_allclose(trajectories.wrists["left"].rotmats[0], flip @ rotation.as_matrix() @ flip, atol=1e-12)
    assert (trajectories.axes, trajectories.at_box, trajectories.up) == ("canonical", True, (0.0, 1.0, 0.0))
    assert (trajectories.mesh_unit, parse_csv(table().encode(), "mine.csv").mesh_unit) == ("dm", "")
    np.testing.assert_allclose(np.diff(trajectories.object_body.time_s), 1 / 120)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (table().replace("right_qz", "right_q"), "none named right_qz"),
        (table(step=1000 / 30), "milliseconds"),
        (table(step=1.0), "frame numbers"),
        (table(scale=1000.0), "--trajectory-unit mm"),
        (table(order="xyzw"), "order w, x, y, z"),
        (table(away_m=0.6), "a palm that comes within"),
        (table().replace("time_s", "seconds"), "time_s"),
        (table().splitlines()[0], "3 to"),
        (with_last_time("1e12"), r"1e\+12 s after row 5"),
        (with_last_time("3600"), "3599.87 s after row 5; cut the file there"),
    ],
)
def test_an_implausible_table_is_refused_with_a_remedy(text: str, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        checked_control(text)


@pytest.mark.parametrize("given_unit", ["m", "cm", "mm", "dm"])
@pytest.mark.parametrize("true_unit", ["m", "cm", "mm"])
def test_the_correct_unit_is_named_for_each_wrong_one(true_unit: str, given_unit: str) -> None:
    text = table(scale=1 / UNITS_M[true_unit])
    if given_unit == true_unit:
        assert checked_control(text, unit=given_unit).active == ["right"]
        return
    with pytest.raises(BadInput) as refused:
        checked_control(text, unit=given_unit)
    assert refused.value.remedy.endswith(f"--trajectory-unit {true_unit}")


def test_a_wrist_in_the_hollow_of_a_mug_is_refused() -> None:
    rings = [trimesh.creation.annulus(0.045, 0.05, 0.1), trimesh.creation.cylinder(0.045, 0.005)]
    mug = model_of(trimesh.util.concatenate(rings), "mug")
    inside = reading(parse_csv(table(scale=0.01).encode(), "mine.csv"), mug, HANDS)
    assert inside.nearest_m["right"] < 0.12
    with pytest.raises(BadInput, match=r"a wrist at least 1.5 cm off mug"):
        checked_control(table(scale=0.01), mug)


def test_wrists_in_other_axes_are_refused_and_the_error_names_both_remedies() -> None:
    with pytest.raises(BadInput, match=r"\(--wrist-axes\) or measure them \(--calibration\)"):
        checked_control(table(), axes="canonical")


def test_files_of_other_formats_are_refused_by_their_suffix(tmp_path: Path) -> None:
    for name, words in (("demo1.txt.gz", "gunzip --keep"), ("mine.cvs", r"\.csv, \.npz, \.txt")):
        (tmp_path / name).write_bytes(b"1")
        with pytest.raises(BadInput, match=words):
            read_trajectories(tmp_path / name)
    (tmp_path / "demo.txt").write_text("120\n")
    with pytest.raises(BadInput, match="--trajectory-unit cm; leave it out"):
        read_trajectories(tmp_path / "demo.txt", "cm")


def test_too_many_frames_at_30_per_second_are_refused() -> None:
    times = np.linspace(0, 1e9, 3)
    still = Motion(times, np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))
    with pytest.raises(BadInput, match="at most 200000 frames"):
        at_rate(Control(dict.fromkeys(SIDES, still), still, BOX))


def test_quaternions_with_w_last_are_refused_in_nearly_every_world_and_w_first_in_none() -> None:
    refused = []
    for world in Rotation.from_quat(np.random.default_rng(0).normal(size=(20, 4))):
        assert checked_control(table(world=world)).active == ["right"]
        try:
            checked_control(table(order="xyzw", world=world))
        except BadInput as error:
            refused.append("put w first" in error.remedy)
    assert sum(refused) >= 19  # 99 % of random worlds: in a few the wrong reading is a plausible grasp too


def test_a_hinged_object_needs_angles_and_an_open_mesh_gives_a_note() -> None:
    with pytest.raises(BadInput, match="hinge_rad"):
        checked_control(table(), notebook(0.02))
    sheet = box_model((0.06, 0.06, 0.1))
    faces = sheet.faces[:6]
    noted = checked_control(table(), type(sheet)("sheet", sheet.vertices_m, faces, sheet.part))
    assert any("no inside" in note for note in noted.notes)


@pytest.mark.parametrize("angle", ["0", "0.5"])
def test_angles_of_a_hinge_need_a_mesh_with_one_unless_they_are_all_zero(angle) -> None:
    head, *rows = table().splitlines()
    text = "\n".join([f"{head},hinge_rad", *(f"{row},{angle}" for row in rows)])
    if angle == "0":
        assert checked_control(text).active == ["right"]
        return
    with pytest.raises(BadInput, match=r"which is rigid; give the hinge of a two-piece mesh \(--hinge"):
        checked_control(text)


def test_an_object_around_the_hand_is_refused_and_a_palm_on_its_surface_is_not() -> None:
    checked_control(table(), box_model((0.06, 0.06, 0.12)))  # the palm is 1 cm inside, as with a coarse mesh
    with pytest.raises(BadInput, match=r"palm inside it in 100 %.*--unit"):
        checked_control(table(), box_model((0.6, 0.6, 1.0)))


def test_damaged_tables_are_refused() -> None:
    head, *rows = table().splitlines()
    first, second, *others = rows
    damaged = [
        [head, second, first, *others],  # times that fall
        [head, first, f"nan{second[second.index(',') :]}", *others],
        [head, f"{first},1", second, *others],  # a cell too many
        [head.replace("object_x", "object_y"), *rows],
        [head.replace("right_", "wrist_"), *rows],
        [head, *(",".join([*row.split(",")[:-1], "2"]) for row in rows)],  # no quaternions of length 1
    ]
    for data in (*("\n".join(lines).encode() for lines in damaged), b"\xff", b""):
        with pytest.raises(BadInput):
            parse_csv(data, "a.csv")


def test_a_gap_is_blended_to_the_poses_before_and_after_it() -> None:
    rng = np.random.default_rng(0)
    predicted = Rotation.from_rotvec(rng.normal(0, 0.3, (20 * 15, 3))).as_matrix().reshape(20, 15, 3, 3)
    start, goal = Rotation.from_rotvec(rng.normal(0, 0.3, (30, 3))).as_matrix().reshape(2, 15, 3, 3)

    def angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return Rotation.from_matrix(np.swapaxes(one, -1, -2).reshape(-1, 3, 3) @ other.reshape(-1, 3, 3)).magnitude()

    blended = blend_ends(predicted, start, goal, 8)
    np.testing.assert_allclose(blended[7:13], predicted[7:13], atol=1e-9)
    assert angles(blended[0], start).max() < 0.15 * angles(predicted[0], start).max()
    assert angles(blended[-1], goal).max() < 0.15 * angles(predicted[-1], goal).max()
    np.testing.assert_allclose(blend_ends(predicted, None, goal, 8)[:13], predicted[:13], atol=1e-9)
    np.testing.assert_array_equal(blend_ends(predicted, None, None, 8), predicted)
    between = interpolated(predicted[0], goal, 3)
    angle = Rotation.from_matrix(predicted[0, 4].T @ goal[4]).magnitude()
    steps = [Rotation.from_matrix(predicted[0, 4].T @ pose[4]).magnitude() / angle for pose in between]
    np.testing.assert_allclose(steps, [0.25, 0.5, 0.75], atol=1e-6)
