"""`hoidata animate` with the commands of docs/fingers.md, in a tiny project with a tiny network, and its messages."""

import json
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from hoidata.clips.clip import SIDES, Clip
from hoidata.errors import BadInput
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import TIP_VERTICES, load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.hands.tracker_offset import sheet_from_wrist
from hoidata.object_paths.trajectory_files import PARTS
from hoidata.sensors.mano_hand import mano_hand
from hoidata.store.store import open_store
from models.common.training import train_network
from models.manipnet.training import MANIPNET
from pipelines.cli import app
from tests.builders.clips import build_clip
from tests.builders.stores import write_annotated
from tests.builders.udp import free_port, send_when_open

LEFT_HAND, HAND = (mano_hand(load_embedded_hands(), side) for side in SIDES)
pytestmark = pytest.mark.slow  # a network is trained, and sensors are compiled
TINY = {
    "network": {"encoder": 8},
    "training": {"steps": 1, "batch": 2, "learning_rate": 0.001, "validate_every": 1},
    "loss": {"steps_per_clip": 4},
}
TRAINED, HELD_OUT, LOST = "toy/s1/0", "toy/s2/1", "toy/s3/2"
FRAMES, BOX_M = 40, (0.06, 0.06, 0.1)


def clips(seed: int | None = None) -> list[Clip]:
    """One clip per subset. The last one's hand is untracked in frames 20 to 24. seed: of random finger poses."""
    subjects = enumerate(("s1", "s2", "s3"))
    built = [
        build_clip(FRAMES, seed=number, clip_id=f"toy/{subject}/{number}", subject=subject)
        for number, subject in subjects
    ]
    is_tracked = np.ones(FRAMES, bool)
    is_tracked[20:25] = False
    built[2] = changed(
        built[2], valid=is_tracked, wrist_m=np.where(is_tracked[:, None], built[2].hands["right"].wrist_m, 0)
    )
    if seed is None:
        return built
    pose = np.random.default_rng(seed).normal(0, 0.5, (FRAMES, 45)).astype(np.float32)
    return [changed(clip, hand_pose=pose) for clip in built]


def changed(clip: Clip, **arrays: np.ndarray) -> Clip:
    return replace(clip, hands={**clip.hands, "right": replace(clip.hands["right"], **arrays)})


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with one dataset and its trained network."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "dvc.yaml").write_text("stages: {}\n")
    (folder / "params.yaml").write_text(yaml.safe_dump({"profile": "embedded", "datasets": ["toy"]}))
    data = write_annotated(folder / "data" / "embedded" / "toy", clips(), points=64)
    train_network(MANIPNET, data, folder / "checkpoints" / "embedded" / "toy" / "manipnet", TINY)
    write_user_files(folder)
    return folder


def write_user_files(folder: Path) -> None:
    """Write mine.csv and mug.obj in metres; demo1.txt and cyl_med.obj mirrored and in decimetres, as ManipNet's are."""
    trimesh.creation.box(BOX_M).export(folder / "mug.obj")
    trimesh.creation.box(np.array(BOX_M) * 10).export(folder / "cyl_med.obj")
    (folder / "mine.csv").write_text(csv_text(HAND))
    (folder / "demo1.txt").write_text(manipnet_text())
    write_tracker_files(folder)
    write_tea_files(folder)


def object_and_wrist_poses(wrist_axes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Quaternions wxyz and positions of a box and a right wrist next to it, fingers along -y; four frames."""
    wrist = Rotation.from_matrix(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) @ wrist_axes)
    rows = []
    for frame in range(4):
        object_m = np.array([0.01 * frame, 0, 0.5])
        bodies = [(Rotation.from_rotvec([0, 0, 0.02 * frame]), object_m), (wrist, object_m + np.array([0, 0.08, 0.07]))]
        rows += [(rotation.as_quat()[[3, 0, 1, 2]], position_m) for rotation, position_m in bodies]
    return rows


def csv_text(hand: TrackedHand) -> str:
    return table(object_and_wrist_poses(hand.wrist_from_canonical.T))


def table(rows: list[tuple[np.ndarray, np.ndarray]], bodies: Sequence[str] = ("object", "right")) -> str:
    """A table of bodies, whose poses alternate; 30 frames per second."""
    lines = ["time_s," + ",".join(f"{body}_{part}" for body in bodies for part in PARTS)]
    for first in range(0, len(rows), len(bodies)):
        poses = rows[first : first + len(bodies)]
        numbers = [part for quaternion, position_m in poses for part in (*position_m, *quaternion)]
        lines.append(",".join(map(str, [first / len(bodies) / 30, *numbers])))
    return "\n".join(lines)


def write_tea_files(folder: Path) -> None:
    """Write pot.obj and tea.csv: the box in the right hand, a pot in the left; and one file for each hand."""
    trimesh.creation.cylinder(0.03, 0.1).export(folder / "pot.obj")
    rows = object_and_wrist_poses(HAND.wrist_from_canonical.T)
    left_rotmat = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, 1]]) @ LEFT_HAND.wrist_from_canonical.T
    left_quaternion = Rotation.from_matrix(left_rotmat).as_quat()[[3, 0, 1, 2]]
    both, left = [], []
    for (quaternion, object_m), right in zip(rows[::2], rows[1::2], strict=True):
        pot_m = object_m + np.array([-0.5, 0, 0.1 * object_m[0]])
        pot, wrist = (quaternion, pot_m), (left_quaternion, pot_m + np.array([0, 0.08, 0.07]))
        both += [(quaternion, object_m), right, pot, wrist]
        left += [pot, wrist, right]
    (folder / "tea.csv").write_text(table(both, ("object", "right", "left_object", "left")))
    (folder / "right.csv").write_text(
        table([pose for i, pose in enumerate(both) if i % 4 != 2], ("object", "right", "left"))
    )
    (folder / "left.csv").write_text(table(left, ("object", "left", "right")))


def write_tracker_files(folder: Path) -> None:
    """Write strapped.csv, mine.csv with a tracker instead of the wrist, and flat.csv, its calibration."""
    wrist_from_tracker = RigidTransform(Rotation.from_rotvec([0.4, -1, 2]).as_matrix(), np.array([0.02, 0.05, -0.03]))
    rows = object_and_wrist_poses(HAND.wrist_from_canonical.T)
    poses = [RigidTransform(Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), position_m) for q, position_m in rows]
    strapped = [pose @ wrist_from_tracker if number % 2 else pose for number, pose in enumerate(poses)]
    sheet = RigidTransform(Rotation.from_rotvec([1.0, 0, 0.5]).as_matrix(), np.array([0.3, 0.2, 0.7]))
    flat = [sheet, sheet @ sheet_from_wrist(HAND) @ wrist_from_tracker] * 40
    for name, transforms in (("strapped", strapped), ("flat", flat)):
        quaternions = [Rotation.from_matrix(pose.rotation).as_quat()[[3, 0, 1, 2]] for pose in transforms]
        text = table([(quaternion, pose.translation) for quaternion, pose in zip(quaternions, transforms, strict=True)])
        (folder / f"{name}.csv").write_text(text)


def manipnet_text() -> str:
    """The same motion with canonical axes, mirrored in x, the left hand far away; 120 lines per second."""
    rows, far = object_and_wrist_poses(np.eye(3)), np.array([0, 0, 0, 1, 30.0, 0, 0])
    lines = ["120"]
    for frame in range(4):
        bodies = [
            np.concatenate([quaternion[[1, 2, 3, 0]] * [1, -1, -1, 1], position_m * [-10, 10, 10]])
            for quaternion, position_m in rows[2 * frame : 2 * frame + 2]
        ]
        lines.append(",".join(map(str, np.concatenate([bodies[0], far, bodies[1]]))))
    return "\n".join(lines)


@pytest.fixture
def typed(tiny: Path, monkeypatch: pytest.MonkeyPatch):
    """A function that runs ``hoidata animate`` in the project; returns the arrays of motion.npz and the page."""
    monkeypatch.chdir(tiny)

    def run(*words: str) -> tuple[dict[str, np.ndarray], str]:
        done = CliRunner().invoke(app, ["animate", *words, "--out", "out"], env={"COLUMNS": "400"})
        if isinstance(done.exception, Exception):
            raise done.exception
        assert done.exit_code == 0, done.output
        assert [Path(line).name for line in done.stdout.split()][:3] == ["motion.npz", "motion.glb", "index.html"]
        assert "does the verb: the object's motion was given, without a verb" in done.stderr
        assert (tiny / "out" / "motion.glb").read_bytes()[:4] == b"glTF"
        return dict(np.load("out/motion.npz")), Path("out/index.html").read_text()

    return run


def test_a_csv_with_a_mesh_keeps_its_wrist_and_object(typed) -> None:
    arrays, page = typed("mine.csv", "--object", "mug.obj")
    np.testing.assert_allclose(arrays["object_translation_m"][:, 0], [0, 0.01, 0.02, 0.03], atol=1e-6)
    np.testing.assert_allclose(arrays["wrist_m"][1] - arrays["object_translation_m"], [[0, 0.08, 0.07]] * 4, atol=1e-6)
    assert arrays["made"].tolist() == [[False] * 4, [True] * 4]
    assert "SYNTHETIC" not in page


def test_a_strapped_on_tracker_with_its_calibration_gives_the_fingers_of_the_wrist(typed) -> None:
    expected, _ = typed("mine.csv", "--object", "mug.obj")
    with pytest.raises(BadInput, match="--calibration"):
        typed("strapped.csv", "--object", "mug.obj")
    arrays, page = typed("strapped.csv", "--object", "mug.obj", "--calibration", "flat.csv")
    for name in ("wrist_m", "global_orient", "hand_pose"):
        np.testing.assert_allclose(arrays[name], expected[name], atol=1e-5)
    assert "the right tracker is 6.2 cm from the wrist joint" in page


def streamed(source: str, *words: str) -> list[dict]:
    """The poses of ``hoidata stream`` for the rows of a table as datagrams."""
    names, *rows = [line.split(",") for line in Path(source).read_text().splitlines()]
    bodies = dict.fromkeys(name.rsplit("_", 1)[0] for name in names[1:])
    datagrams = []
    for cells in rows:
        columns = dict(zip(names, map(float, cells), strict=True))
        poses = {body: [columns[f"{body}_{part}"] for part in PARTS] for body in bodies}
        datagrams.append(json.dumps({"time_s": columns["time_s"], **poses}).encode())
    tracker = threading.Thread(target=send_when_open, args=(port := free_port(), [*datagrams, b'{"end": true}']))
    tracker.start()
    command = ("stream", "--from", f"udp://:{port}", "--out", "live")
    done = CliRunner().invoke(app, [*command, *words], catch_exceptions=False)
    tracker.join()
    assert done.exit_code == 0, done.output
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_tracker_over_udp_is_calibrated_too(tiny: Path, monkeypatch) -> None:
    monkeypatch.chdir(tiny)
    words = ("--object", "mug.obj", "--fingers", "right")
    expected, poses = streamed("mine.csv", *words), streamed("strapped.csv", *words, "--calibration", "flat.csv")
    assert len(poses) == len(expected) == 4
    np.testing.assert_allclose(*([pose["right"] for pose in hand_poses] for hand_poses in (poses, expected)), atol=1e-4)


def test_each_hand_holds_its_own_object_and_the_files_have_both(tiny: Path, typed, monkeypatch) -> None:
    words = ("--object", "mug.obj", "--left-object", "pot.obj")
    both, page = typed("tea.csv", *words)
    right, _ = typed("right.csv", "--object", "mug.obj", "--fingers", "right")
    left, _ = typed("left.csv", "--object", "pot.obj", "--fingers", "left")
    np.testing.assert_allclose(both["hand_pose"][1], right["hand_pose"][1], atol=1e-5)
    np.testing.assert_allclose(both["hand_pose"][0], left["hand_pose"][0], atol=1e-5)
    np.testing.assert_array_equal(both["left_object_translation_m"], left["object_translation_m"])
    np.testing.assert_array_equal(both["object_translation_m"], right["object_translation_m"])
    assert both["made"].all()
    assert "mug, pot" in page
    store = tiny / "tea-store"
    poses = streamed("tea.csv", *words, "--store", str(store))
    command = ("stream", "--from", "tea.csv", "--fast", "--out", "live", *words)
    lines = CliRunner().invoke(app, command, catch_exceptions=False).stdout.splitlines()
    assert [json.loads(line) for line in lines] == poses
    for index, side in enumerate(SIDES):
        np.testing.assert_allclose(
            np.reshape([pose[side] for pose in poses], (4, 45)), both["hand_pose"][index], atol=1e-4
        )
    clip = open_store(store).clip("animated/live")
    assert (clip.object.model.name, [track.model.name for track in clip.other_objects]) == ("mug", ["pot"])
    np.testing.assert_allclose(clip.other_objects[0].translation_m, both["left_object_translation_m"], atol=1e-6)
    glb = trimesh.load(tiny / "live" / "motion.glb")
    assert "other object 0" in glb.graph.nodes


def test_a_scale_changes_the_mesh_and_not_the_trajectories(tiny: Path, typed) -> None:
    trimesh.creation.box(np.array(BOX_M) * 1.2).export(tiny / "large.obj")
    plain, _ = typed("mine.csv", "--object", "mug.obj")
    scaled, _ = typed("mine.csv", "--object", "mug.obj", "--scale", "1.2")
    large, _ = typed("mine.csv", "--object", "large.obj")
    np.testing.assert_allclose(scaled["hand_pose"], large["hand_pose"], atol=1e-6)
    assert np.abs(scaled["hand_pose"] - plain["hand_pose"]).max() > 1e-4
    for name in ("wrist_m", "object_translation_m", "object_rotvec"):
        np.testing.assert_array_equal(scaled[name], plain[name])


def test_the_hand_has_the_given_length_in_all_results(tiny: Path, typed) -> None:
    model = load_embedded_hands().right
    mean_cm = 100 * np.linalg.norm(model.template_m[TIP_VERTICES[1]] - model.wrist_offset_m(np.zeros(10)))
    plain, _ = typed("mine.csv", "--object", "mug.obj")
    store = tiny / "long-hand"
    arrays, _ = typed("mine.csv", "--object", "mug.obj", "--hand-length", f"{1.1 * mean_cm}", "--store", str(store))
    palms_m = [result["joints_m"][1, :, 4] - result["joints_m"][1, :, 0] for result in (arrays, plain)]
    np.testing.assert_allclose(
        *(np.linalg.norm(palm_m, axis=1) * k for palm_m, k in zip(palms_m, (1, 1.1), strict=True)), rtol=1e-5
    )
    np.testing.assert_allclose(arrays["template_m"][1], 1.1 * model.template_m, atol=1e-6)
    np.testing.assert_array_equal(arrays["wrist_m"], plain["wrist_m"])
    assert np.abs(arrays["hand_pose"] - plain["hand_pose"]).max() > 1e-4
    np.testing.assert_allclose(open_store(store).joints("animated/mine", "right"), arrays["joints_m"][1], atol=1e-5)


def test_motion_npz_has_the_given_frame_rate_and_the_other_files_have_30(typed) -> None:
    plain, _ = typed("mine.csv", "--object", "mug.obj")
    arrays, page = typed("mine.csv", "--object", "mug.obj", "--fps", "60")
    assert arrays["fps"] == 60
    assert arrays["made"].shape == (2, 7)
    assert "4 frames, 0.13 s" in page
    for name in ("wrist_m", "hand_pose", "object_translation_m"):
        np.testing.assert_allclose(arrays[name][..., ::2, :], plain[name], atol=1e-3)
    np.testing.assert_allclose(arrays["object_translation_m"][:, 0], np.arange(7) * 0.005, atol=1e-6)


def test_at_the_ends_a_lost_object_cuts_the_motion_and_a_lost_wrist_makes_frames_invalid(tiny: Path, typed) -> None:
    lines = [line.split(",") for line in (tiny / "mine.csv").read_text().splitlines()]
    lines[1][1:8], lines[4][8:15] = [""] * 7, [""] * 7
    (tiny / "ends.csv").write_text("\n".join(map(",".join, lines)))
    arrays, page = typed("ends.csv", "--object", "mug.obj")
    np.testing.assert_allclose(arrays["time_s"], np.arange(1, 4) / 30)
    assert arrays["valid"][1].tolist() == arrays["made"][1].tolist() == [True, True, False]
    assert "the motion is cut to 0.03 to 0.10 s, where the object is tracked" in page


def test_a_streamed_file_has_a_unit_and_a_tracker_has_none(tiny: Path, typed, monkeypatch) -> None:
    rows = [line.split(",") for line in (tiny / "mine.csv").read_text().splitlines()]
    for cells in rows[1:]:
        for column in (1, 2, 3, 8, 9, 10):
            cells[column] = str(100 * float(cells[column]))
    (tiny / "cm.csv").write_text("\n".join(map(",".join, rows)))
    words = ("--object", "mug.obj", "--trajectory-unit", "cm")
    expected, _ = typed("cm.csv", *words)
    command = ("stream", "--from", "cm.csv", "--fast", "--out", "live", *words)
    lines = CliRunner().invoke(app, command, catch_exceptions=False).stdout.splitlines()
    poses = np.reshape([json.loads(line)["right"] for line in lines], (4, 45))
    np.testing.assert_allclose(poses, expected["hand_pose"][1], atol=1e-4)
    with pytest.raises(BadInput, match="a tracker, which sends metres"):
        CliRunner().invoke(app, ["stream", "--from", "udp://:9000", "--out", "live", *words], catch_exceptions=False)


def test_a_tracker_without_a_usable_frame_ends_with_the_reason(tiny: Path, monkeypatch) -> None:
    monkeypatch.chdir(tiny)
    tracker = threading.Thread(target=send_when_open, args=(port := free_port(), [b'{"time_s":"1"}', b'{"end": true}']))
    tracker.start()
    command = ["stream", "--from", f"udp://:{port}", "--out", "none", "--object", "mug.obj"]
    with pytest.raises(BadInput, match=r"in 3 frames, got 0 frames; .* datagrams were refused"):
        CliRunner().invoke(app, command, catch_exceptions=False)
    tracker.join()
    assert not (tiny / "none").exists()


def test_manipnets_text_file_and_mesh_are_mirrored(typed) -> None:
    arrays, page = typed("demo1.txt", "--object", "cyl_med.obj")
    np.testing.assert_allclose(arrays["wrist_m"][1] - arrays["object_translation_m"], [[0, 0.08, 0.07]], atol=1e-6)
    assert arrays["made"].tolist() == [[False], [True]]
    assert "the left hand stays" in page


def test_an_animated_clip_keeps_everything_but_the_chosen_fingers_and_frames(typed) -> None:
    arrays, page = typed(TRAINED, "--fingers", "right", "--frames", "10:30", "--way", "network")
    clip = clips()[0]
    np.testing.assert_allclose(arrays["object_translation_m"], clip.object.translation_m, atol=1e-6)
    np.testing.assert_allclose(arrays["wrist_m"][1], clip.hands["right"].wrist_m, atol=1e-6)
    assert np.flatnonzero(arrays["made"][1]).tolist() == list(range(10, 30))
    assert not arrays["made"][0].any()
    assert "the network trained on this clip" in page
    assert "blended over 1 s with the known pose before and after" in page


def test_recorded_fingers_do_not_affect_the_animation(tiny: Path, typed) -> None:
    typed(HELD_OUT)
    before = (tiny / "out" / "motion.npz").read_bytes()
    data, backup = tiny / "data" / "embedded" / "toy", tiny / "kept"
    data.rename(backup)
    try:
        write_annotated(data, clips(seed=3), points=64)
        typed(HELD_OUT)
        assert (tiny / "out" / "motion.npz").read_bytes() == before
    finally:
        data.rename(tiny / "random_fingers")
        backup.rename(data)


def test_a_short_gap_is_interpolated_and_an_untracked_hand_is_reported(typed) -> None:
    arrays, page = typed(LOST, "--fingers", "right", "--frames", "15:30")
    assert "interpolated between the known poses" in page
    assert "is not tracked in 5 of the 15 frames" in page
    wrist = clips()[2].hands["right"].wrist_m
    np.testing.assert_allclose(arrays["wrist_m"][1, 20:25], wrist[[19, 19, 19, 25, 25]], atol=1e-6)


def test_motion_of_a_network_trained_on_synthetic_clips_is_marked(tiny: Path, typed, monkeypatch) -> None:
    import pipelines.animation as animation

    chosen = animation.chosen_network

    def synthetic(*arguments):
        network = chosen(*arguments)
        return replace(network, facts={**network.facts, "synthetic": True})

    monkeypatch.setattr(animation, "chosen_network", synthetic)
    assert "SYNTHETIC" in typed("mine.csv", "--object", "mug.obj")[1]


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (("mine.csv", "--object", "mug.obj", "--fingers", "left"), "mine.csv has right, near the object right"),
        (("demo1.txt", "--object", "cyl_med.obj", "--fingers", "left"), "has left and right, near the object right"),
        (("mine.csv", "--object", "mug.obj", "--way", "interpolate"), "no poses to interpolate between"),
        (("mine.csv", "--object", "mug.obj", "--model", "nope"), "params.yaml: toy, got nope"),
        (("mine.csv", "--object", "box", "--unit", "cm"), "--unit: expected a mesh file"),
        (("mine.csv", "--object", "box", "--hinge", "1,0,0", "--moving", "a"), "--hinge, --moving: expected a mesh"),
        (
            ("tea.csv", "--object", "box", "--left-object", "pot.obj", "--moving", "a", "--unit", "m"),
            "^--moving: expected a mesh",
        ),
        (("mine.cvs",), r"\.csv, \.npz, \.txt"),
        (("demo1.txt.gz",), "gunzip"),
        ((TRAINED, "--object", "mug.obj"), "--object: expected no such option with a clip"),
        ((TRAINED, "--world-up", "z"), "--world-up: expected no such option with a clip"),
        ((TRAINED, "--calibration", "flat.csv"), "--calibration: expected no such option with a clip"),
        ((TRAINED, "--left-object", "pot.obj"), "--left-object: expected no such option with a clip"),
        (("tea.csv", "--object", "mug.obj"), "a mesh and left_object columns, or neither"),
        (("right.csv", "--object", "mug.obj", "--left-object", "pot.obj"), "a mesh and left_object columns"),
        ((TRAINED, "--fps", "60"), "--fps: expected no such option with a clip"),
        ((TRAINED, "--hand-length", "18"), "--hand-length: expected no such option with a clip"),
        ((TRAINED, "--scale", "2"), "--scale: expected no such option with a clip"),
        (("strapped.csv", "--object", "mug.obj", "--calibration", "flat.csv", "--wrist-axes", "canonical"), "omit it"),
        (("demo1.txt", "--object", "cyl_med.obj", "--calibration", "flat.csv"), "the tracker on the left hand"),
        ((TRAINED, "--trajectory-unit", "cm"), "--trajectory-unit: expected no such option with a clip"),
        ((TRAINED, "--frames", "0:9", "--way", "interpolate"), "known poses on both sides"),
        (("toy/s1/9",), "closest: toy/s1/0"),
    ],
)
def test_unusable_options_are_refused(typed, words: tuple[str, ...], answer: str) -> None:
    with pytest.raises(BadInput, match=answer):
        typed(*words)
