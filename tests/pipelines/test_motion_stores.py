"""The stores that ``generate``, ``animate``, ``stream`` and ``hands`` write fit every export, page and metric."""

import json
import shutil
import socket
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from hoidata.clips.clip import SIDES, Clip
from hoidata.errors import BadInput
from hoidata.files.numpy_files import load_npz_arrays
from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store
from hoidata.object_paths.trajectory_files import PARTS
from hoidata.store.store import open_store
from models.common.training import train_network
from models.registry import load_network
from pipelines import command_inputs
from pipelines.cli import app
from pipelines.command_inputs import write_motion_store
from pipelines.exports.spider import TIPS
from tests.builders.clips import build_clip
from tests.builders.stores import write_annotated
from tests.builders.udp import free_port, send_when_open
from tests.models.bimart.test_family import PARAMS
from tests.pipelines.conftest import TINY
from tests.pipelines.exports import readers
from tests.pipelines.test_animation import TINY as TINY_MANIPNET

pytestmark = [pytest.mark.slow, pytest.mark.long]
NETWORKS = TINY | {"manipnet": TINY_MANIPNET, "bimart-contact": PARAMS, "bimart-motion": PARAMS}
FRAMES, CLIP = 20, "toy/s3/2"
READ_BACK = ("lerobot", "huggingface", "webdataset", "glb", "usd", "bvh")
COMMANDS = {
    "generate": (
        "generate",
        "Lift the box with both hands.",
        "--object",
        "box.obj",
        "--hand",
        "both",
        "--length",
        "0.5",
    ),
    "animate": ("animate", CLIP),
    "stream": ("stream", "--from", "mine.csv", "--object", "mug.obj", "--world-up", "z"),
    "hands": ("hands", "--clip", CLIP, "--samples", "2"),
}


def clips() -> list[Clip]:
    """A clip with both hands per subset; without real recordings, so that the networks may be shared."""
    subjects = enumerate(("s1", "s2", "s3"))
    return [
        build_clip(FRAMES, "both", seed=number, clip_id=f"toy/{subject}/{number}", subject=subject)
        for number, subject in subjects
    ]


def csv_text(clip: Clip) -> str:
    """The wrists and the object of a clip as a file of trajectories, 30 frames per second."""
    bodies = {side: (clip.hands[side].wrist_m, clip.hands[side].global_orient) for side in SIDES}
    bodies |= {"object": (clip.object.translation_m, clip.object.rotvec)}
    lines = ["time_s," + ",".join(f"{body}_{part}" for body in bodies for part in PARTS)]
    for frame in range(FRAMES):
        numbers = [np.array([frame / 30])]
        for position_m, rotvec in bodies.values():
            numbers += [position_m[frame], Rotation.from_rotvec(rotvec[frame]).as_quat()[[3, 0, 1, 2]]]
        lines.append(",".join(map(str, np.concatenate(numbers))))
    return "\n".join(lines)


def typed(*words: object) -> str:
    done = CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "400"}, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with one dataset on which all networks of the four commands are trained for a few steps."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "dvc.yaml").write_text("stages: {}\n")
    params = {"profile": "embedded", "datasets": ["toy"], "annotate": {"encoder": "hash"}}
    (folder / "params.yaml").write_text(yaml.safe_dump(params))
    recorded = clips()
    data = write_annotated(folder / "data" / "embedded" / "toy", recorded)
    checkpoints = folder / "checkpoints" / "embedded" / "toy"
    for name, settings in NETWORKS.items():
        network = load_network(name)
        needed = {load_network(other): checkpoints / other for other in network.needs}
        train_network(network, data, checkpoints / name, settings, needed=needed)
    trimesh.creation.box((0.2, 0.2, 0.2)).export(folder / "box.obj")
    model = recorded[0].object.model
    trimesh.Trimesh(model.vertices_m, model.faces, process=False).export(folder / "mug.obj")
    (folder / "mine.csv").write_text(csv_text(recorded[0]))
    return folder


@pytest.fixture(scope="module")
def stores(project: Path) -> Mapping[str, Path]:
    """The store that each command writes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(project)
        for name, words in COMMANDS.items():
            typed(*words, "--out", f"out/{name}", "--store", f"stores/{name}")
    return {name: project / "stores" / name for name in COMMANDS}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("form", READ_BACK)
def test_every_export_of_every_store_is_read_by_its_own_library(command, form, stores, tmp_path) -> None:
    store = open_store(stores[command])
    typed("export", store.folder, "--to", form, "--out", tmp_path / form, "--for-own-use")
    read = readers.read(form, tmp_path / form, tmp_path / "cache")
    assert set(read) == set(store.ids)
    for clip_id, (left, right, world_from_object) in read.items():
        for side, joints_m in zip(SIDES, (left, right), strict=True):
            np.testing.assert_allclose(joints_m, store.joints(clip_id, side), atol=1e-4)
        track = store.clip(clip_id).object
        np.testing.assert_allclose(world_from_object[:, :3, 3], track.translation_m, atol=1e-4)


@pytest.mark.parametrize("command", COMMANDS)
def test_spider_gets_tips_and_mesh_of_every_store(command, stores, tmp_path) -> None:
    store = open_store(stores[command])
    typed("export", store.folder, "--to", "spider", "--out", tmp_path / "spider", "--for-own-use")
    tasks = sorted((tmp_path / "spider").rglob("task_info.json"))
    assert len(tasks) == len(store)
    for clip_id, path in zip(sorted(store.ids), tasks, strict=True):
        arrays, track = load_npz_arrays(path.parent / "0" / "trajectory_keypoints.npz"), store.clip(clip_id).object
        from_object_m = arrays["qpos_finger_right"][:, :, :3] - arrays["qpos_obj_right"][:, None, :3]
        expected_m = store.joints(clip_id, "right")[:, list(TIPS)] - track.translation_m[:, None]
        # Distances do not depend on the world's axes, which SPIDER needs z up.
        np.testing.assert_allclose(*(np.linalg.norm(m, axis=-1) for m in (from_object_m, expected_m)), atol=1e-5)
        folder = json.loads(path.read_text())["right_object_mesh_dir"]
        mesh: Any = trimesh.load(tmp_path / "spider" / folder / "visual.obj", process=False)
        np.testing.assert_allclose(
            mesh.bounds, [track.model.vertices_m.min(0), track.model.vertices_m.max(0)], atol=1e-5
        )


@pytest.mark.filterwarnings("ignore:ConjunctiveGraph is deprecated", "ignore:The inplace keyword")  # of mlcroissant
@pytest.mark.parametrize("command", COMMANDS)
def test_croissant_reads_the_tables_of_every_store(command, stores, tmp_path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant", reason="the extra croissant, which pyright must not see")
    folder = shutil.copytree(stores[command], tmp_path / "store")
    typed("export", folder, "--to", "croissant", "--out", tmp_path / "export", "--for-own-use")
    shutil.copy(tmp_path / "export" / "croissant.json", folder)
    dataset = mlcroissant.Dataset(jsonld=folder / "croissant.json")
    assert not dataset.metadata.ctx.issues.errors
    ids = [sequence["meta_sequences/clip_id"].decode() for sequence in dataset.records("meta_sequences")]
    assert ids == open_store(folder).ids


@pytest.mark.parametrize("command", COMMANDS)
def test_every_store_is_sound_has_a_page_and_equals_motion_npz(command, stores, project) -> None:
    assert "sound" in typed("validate", stores[command])
    store = open_store(stores[command])
    page = Path(typed("show", store.ids[0], "--data", store.folder, "--out", project / "pages" / command).strip())
    assert store.ids[0] in page.read_text()
    for number, clip_id in enumerate(store.ids):
        arrays = load_npz_arrays(project / "out" / command / (f"motion-{number}.npz" if number else "motion.npz"))
        clip = store.clip(clip_id)
        for side_index, side in enumerate(SIDES):
            np.testing.assert_allclose(clip.hands[side].hand_pose, arrays["hand_pose"][side_index], atol=1e-6)
        np.testing.assert_allclose(clip.object.translation_m, arrays["object_translation_m"], atol=1e-6)


@pytest.mark.parametrize("command", ["animate", "hands"])
def test_motions_for_a_recorded_clip_are_evaluated_against_it(command, stores, project) -> None:
    results = evaluate_store(stores[command], project / "data" / "embedded" / "toy")
    assert results["motions"] == len(open_store(stores[command]))
    assert results["left_out"] == []


def test_kept_hands_are_one_of_the_samples(project, stores, monkeypatch) -> None:
    monkeypatch.chdir(project)
    typed(*COMMANDS["hands"], "--keep", "1", "--out", "out/kept")
    (path,) = (project / "out/kept").glob("motion*.npz")
    assert path.read_bytes() == (project / "out/hands" / path.name).read_bytes()


def test_a_generated_motion_keeps_the_verb_and_the_sentence(stores) -> None:
    clip = open_store(stores["generate"]).clip("generated/box")
    assert (clip.verb, clip.sequence) == ("lift", COMMANDS["generate"][1])


def test_a_stream_prints_every_pose_and_moves_like_animate(project, stores, monkeypatch) -> None:
    monkeypatch.chdir(project)
    words = COMMANDS["stream"][1:]
    typed("animate", *words[1:], "--out", "out/all-at-once", "--store", "stores/all-at-once")
    whole, live = (open_store(project / "stores" / name) for name in ("all-at-once", "stream"))
    lines = typed("stream", *words, "--out", "out/again", "--fast").splitlines()
    poses = [json.loads(line) for line in lines]
    assert [pose["time_s"] for pose in poses] == pytest.approx(np.arange(FRAMES) / 30, abs=1e-5)
    for side in SIDES:
        rotvec = np.array([pose[side] for pose in poses]).reshape(FRAMES, 45)
        np.testing.assert_allclose(rotvec, live.clip(live.ids[0]).hands[side].hand_pose, atol=1e-5)
        # Each pose is an input of the next, so roundings add up over frames.
        np.testing.assert_allclose(rotvec, whole.clip(whole.ids[0]).hands[side].hand_pose, atol=3e-4)


def test_a_tracker_over_udp_gets_the_poses_of_a_file_and_a_store(project, monkeypatch) -> None:
    monkeypatch.chdir(project)
    words = ("stream", "--object", "mug.obj", "--world-up", "z")
    expected = typed(*words, "--from", "mine.csv", "--out", "out/file", "--fast").splitlines()
    names, *rows = [line.split(",") for line in Path("mine.csv").read_text().splitlines()]
    datagrams = [b"nonsense"]
    for row in rows:
        columns = dict(zip(names, map(float, row), strict=True))
        bodies = {body: [columns[f"{body}_{part}"] for part in PARTS] for body in ("object", *SIDES)}
        datagrams.append(json.dumps({"time_s": columns["time_s"], **bodies}).encode())
    with socket.socket(type=socket.SOCK_DGRAM) as viewer:
        viewer.bind(("127.0.0.1", 0))
        viewer.settimeout(60)
        port = free_port()
        tracker = threading.Thread(target=send_when_open, args=(port, [*datagrams, b'{"end": true}']))
        tracker.start()
        source, to = f"udp://127.0.0.1:{port}", f"udp://127.0.0.1:{viewer.getsockname()[1]}"
        lines = typed(*words, "--from", source, "--to", to, "--out", "out/udp", "--store", "stores/udp").splitlines()
        tracker.join()
        assert [viewer.recv(4096).decode() for _ in lines] == lines
    assert len(lines) == len(expected) == FRAMES
    store = open_store("stores/udp")
    (clip,) = (store.clip(clip_id) for clip_id in store.ids)
    for side in SIDES:
        fingers = [np.array([json.loads(line)[side] for line in given]) for given in (lines, expected)]
        np.testing.assert_allclose(*fingers, atol=1e-5)
        np.testing.assert_allclose(clip.hands[side].hand_pose, fingers[0].reshape(FRAMES, 45), atol=1e-5)
        assert clip.hands[side].valid.all()
    assert "datagrams were refused" in Path("out/udp/index.html").read_text()


def test_a_path_that_exists_is_never_replaced(project, stores, monkeypatch) -> None:
    monkeypatch.chdir(project)
    before = {path: path.read_bytes() for path in stores["animate"].rglob("*") if path.is_file()}
    for words in COMMANDS.values():
        with pytest.raises(BadInput, match="a path that does not exist for --store"):
            typed(*words, "--out", "refused", "--store", stores["animate"])
    assert before == {path: path.read_bytes() for path in stores["animate"].rglob("*") if path.is_file()}
    assert not Path("refused").exists()


def test_an_error_while_writing_leaves_no_store(tmp_path) -> None:
    good = build_clip(4, clip_id="a/b/c")
    broken = build_clip(4, clip_id="a/b/d", gravity=(0.0, 0.0, -2.0))
    with pytest.raises(BadInput, match="a unit vector"):
        write_motion_store(tmp_path / "store", [good, broken], load_embedded_hands(), {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("networks", "source", "licence", "may_be_shared"),
    [
        ({"synthetic": True, "datasets": {"grab": 3}}, {}, "none: generated", True),
        ({"synthetic": False, "datasets": {"grab": 3}}, {}, "that of grab, training data", False),
        ({}, {"licence": "CC0-1.0", "may_be_shared": True}, "none: generated", True),
        ({"synthetic": True, "datasets": {"toy": 3}}, {"licence": "MPI", "may_be_shared": False}, "MPI", False),
    ],
)
def test_the_licence_is_that_of_the_recordings_behind_a_motion(
    networks: dict[str, Any], source: dict[str, Any], licence: str, may_be_shared: bool, tmp_path
) -> None:
    write_motion_store(tmp_path / "store", [build_clip(4)], load_embedded_hands(), networks, **source)
    info = command_inputs.open_store(tmp_path / "store").info
    assert (info["licence"], info["may_be_shared"]) == (licence, may_be_shared)
