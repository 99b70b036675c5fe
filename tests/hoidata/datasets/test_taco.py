"""TACO's adapter on files written here as the format notes have them: pickles of torch tensors, OBJ in centimetres."""

import io
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.annotation.sentences import four_sentences
from hoidata.clips.clip import SIDES, Clip, HandTrack
from hoidata.clips.validation import check_clip
from hoidata.conformance.check import check_adapter
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import RawTree, SequenceKey
from hoidata.datasets.taco.adapter import TacoAdapter, frames_of, triplet
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.store.store import open_store

HANDS = load_embedded_hands()
N_FRAMES = 30
HALF_TOOL_M = np.array([0.035, 0.03, 0.02])
NAMES = (
    "(brush, brush, bowl)/20230927_034",
    "(put in, spoon, bowl)/20230928_001",
    "(put in, spoon, bowl)/20230928_002",
)
KEY = SequenceKey("taco", "20230927", NAMES[0])


def dump(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value))


def write_box(path: Path, half_m: np.ndarray) -> None:
    mesh = trimesh.creation.box(2 * half_m * 100)
    path.parent.mkdir(parents=True, exist_ok=True)
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in mesh.vertices)
    path.write_text(vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in mesh.faces + 1))


def write_recording(root: Path, name: str, seed: int) -> None:
    """Both hands hold the tool, which is moved and turned above a bowl that stands still; its ids are 012 and 105."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, N_FRAMES)[:, None]
    turn = Rotation.from_rotvec(rng.normal(0, 0.6, 3) + time * rng.normal(0, 1.2, 3))
    place = np.array([0.3, -0.2, 1.0]) + time * rng.normal(0, 0.2, 3)
    tool, target = np.tile(np.eye(4), (2, N_FRAMES, 1, 1))
    tool[:, :3, :3], tool[:, :3, 3], target[:, :3, 3] = turn.as_matrix(), place, (0.3, -0.2, 0.8)
    folder = root / "Object_Poses" / name
    folder.mkdir(parents=True)
    np.save(folder / "tool_012.npy", tool.astype(np.float32))
    np.save(folder / "target_105.npy", target.astype(np.float32))
    for side in SIDES:
        poses, betas = hand(side, turn, place, rng)
        dump(root / "Hand_Poses" / name / f"{side}_hand.pkl", poses)
        dump(root / "Hand_Poses" / name / f"{side}_hand_shape.pkl", {"hand_shape": torch.tensor(betas).float()})


def hand(side: str, turn: Rotation, place: np.ndarray, rng: np.random.Generator) -> tuple[dict, np.ndarray]:
    """The middle of index, middle and ring tip lies on one side of the tool; frame keys count from 00001."""
    betas, fingers = rng.normal(0, 0.3, 10), HANDS[side].mean_pose + rng.normal(0, 0.05, 45)
    flat = HandTrack(np.zeros((1, 3)), np.zeros((1, 3)), fingers[None], betas[None], np.ones(1, dtype=bool))
    tips = track_joints(flat, HANDS[side])[0, [16, 17, 19]].mean(axis=0)
    wrist = place + turn.apply(HALF_TOOL_M * ((1, 0, 0) if side == "right" else (-1, 0, 0)) - tips)
    poses = {
        f"{frame + 1:05d}": {
            "hand_pose": torch.tensor(np.concatenate((turn.as_rotvec()[frame], fingers))).float(),
            "hand_trans": torch.tensor(wrist[frame]).float(),
        }
        for frame in range(N_FRAMES)
    }
    return poses, betas


def write_taco(root: Path) -> Path:
    for seed, name in enumerate(NAMES):
        write_recording(root, name, seed)
    write_box(root / "Object_Models" / "012_cm.obj", HALF_TOOL_M)
    write_box(root / "Object_Models" / "105_cm.obj", np.array([0.08, 0.08, 0.03]))
    return root


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_taco(tmp_path / "taco")


def load(root: Path, **settings) -> Clip:
    (clip,) = TacoAdapter(**settings).load(RawTree(root), KEY, HANDS)
    assert isinstance(clip, Clip)
    return check_clip(clip)


def hand_file(root: Path, side: str = "right") -> Path:
    return root / "Hand_Poses" / NAMES[0] / f"{side}_hand.pkl"


def edit(path: Path, change: Callable[[dict], object]) -> None:
    """Change a pickle this test wrote itself."""
    value = pickle.loads(path.read_bytes())
    change(value)
    dump(path, value)


def test_it_keeps_every_rule_of_the_conformance_check(root: Path) -> None:
    findings = check_adapter(TacoAdapter(), root, HANDS, worker=False)
    assert [item for item in findings if item.outcome not in ("pass", "skip")] == []
    assert [item.rule for item in findings if item.outcome == "skip"] == ["a worker process gives the same"]


def test_a_recording_becomes_one_clip_with_words_from_its_triplet(root: Path) -> None:
    clip = load(root)
    assert clip.clip_id == "taco/(brush, brush, bowl)/20230927_034"
    assert (clip.verb, clip.object_words, clip.subject) == ("brush", "brush", "20230927")
    assert [str(key) for key in TacoAdapter().sequences(root)] == [f"taco/{name}" for name in sorted(NAMES)]
    assert triplet(NAMES[1]) == ("put in", "spoon", "bowl")
    assert clip.gravity is None
    assert "day to day" in clip.gravity_note
    assert clip.source_fps == 30
    np.testing.assert_array_equal(clip.source_frames, np.arange(N_FRAMES))


def test_its_words_make_sentences() -> None:
    verb, noun, _ = triplet(NAMES[1])
    assert four_sentences(verb, noun, "right")[0] == "Put in a spoon with the right hand."


def test_a_clip_names_the_eight_files_it_was_made_from(root: Path) -> None:
    hands = [f"Hand_Poses/{NAMES[0]}/{side}_hand{kind}.pkl" for side in SIDES for kind in ("", "_shape")]
    objects = [f"Object_Poses/{NAMES[0]}/{name}.npy" for name in ("target_105", "tool_012")]
    models = [f"Object_Models/{name}_cm.obj" for name in ("012", "105")]
    assert [source.path for source in load(root).sources] == sorted(hands + objects + models)


def test_a_hand_without_an_entry_for_a_frame_is_not_valid_there(root: Path) -> None:
    edit(hand_file(root), lambda poses: [poses.pop(key) for key in ("00001", "00008", "00030")])
    clip = load(root)
    np.testing.assert_array_equal(np.flatnonzero(~clip.hands["right"].valid), [0, 7, 29])
    assert clip.hands["left"].valid.all()
    assert clip.hands["right"].wrist_m[8].any()


def keys(*numbers: int, width: int = 0) -> list:
    return [f"{number:0{width}d}" for number in numbers]


@pytest.mark.parametrize(
    ("left", "right", "frames"),
    [
        (keys(0, 1, 2), keys(0, 2), [0, 2]),
        (keys(1, 2, 3, width=5), keys(2, width=5), [1]),
        (keys(100, 101, 103), keys(101, 103), [1, 2]),
        (keys(0, 1), keys(1), [1]),
        (keys(1, 3), keys(2), [1]),
        ([0, 1, 2], [2, 0], [2, 0]),
        (keys(0, 1, 2), [], []),
        (keys(5, 6, 7), keys(8, 10, 9), [0, 2, 1]),
        (["frame_9", "frame_10", "frame_11"], ["frame_11"], [2]),
    ],
)
def test_frame_keys_are_placed_by_their_numbers(left: list, right: list, frames: list[int]) -> None:
    placed = frames_of("triplet/recording", {"left": left, "right": right}, 3)["right"]
    assert [placed[key] for key in right] == frames


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (keys(1), keys(2), "which ones cannot be told"),
        ([], [], "which ones cannot be told"),
        (keys(0, 3), keys(1), "which ones cannot be told"),
        (keys(0, 1, 2), keys(7), "frame numbers 0 to 2, got 7"),
        (keys(0, 1, 2, 3), keys(1), "at most 3 frames"),
        (["a", "b", "c"], keys(1), "frame numbers as keys, got 'a'"),
        (["1", "01", "2"], keys(1), "twice"),
        ([True, "2"], keys(1), "frame numbers as keys"),
        (["0.033", "0.067"], keys(1), "frame numbers as keys, got '0.033'"),
        ([(0,), "2"], keys(1), "frame numbers as keys"),
    ],
)
def test_frame_keys_that_tell_no_frame_are_refused(left: list, right: list, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        frames_of("triplet/recording", {"left": left, "right": right}, 3)


def test_the_clip_reaches_from_the_first_to_the_last_touch_and_a_margin_widens_it(root: Path) -> None:
    def away(poses: dict, frames: range) -> None:
        for frame in frames:
            poses[f"{frame + 1:05d}"]["hand_trans"] += 0.5

    for side in SIDES:
        edit(hand_file(root, side), lambda poses: away(poses, range(6)))
    edit(hand_file(root, "left"), lambda poses: away(poses, range(20, 30)))
    edit(hand_file(root, "right"), lambda poses: away(poses, range(24, 30)))
    np.testing.assert_array_equal(load(root).source_frames, np.arange(6, 24))
    np.testing.assert_array_equal(load(root, margin_frames=4).source_frames, np.arange(2, 28))
    np.testing.assert_array_equal(load(root, margin_frames=99).source_frames, np.arange(N_FRAMES))
    assert load(root, margin_frames=99).clip_id == load(root).clip_id


def test_a_margin_that_is_no_whole_number_is_refused() -> None:
    with pytest.raises(BadInput, match="whole number of 0 or more"):
        TacoAdapter(margin_frames=-1)


def cuda_tagged(data: bytes) -> bytes:
    """The same pickles as saved on a GPU: the location in each storage is ``cuda:0``."""

    class Tagged(pickle.Pickler):
        def reducer_override(self, value):
            if isinstance(value, torch.UntypedStorage | torch.TypedStorage):
                stream = io.BytesIO()
                torch.save(value, stream, _use_new_zipfile_serialization=False)
                saved = stream.getvalue().replace(b"X\x03\x00\x00\x00cpu", b"X\x06\x00\x00\x00cuda:0")
                assert saved != stream.getvalue()
                return torch.storage._load_from_bytes, (saved,)
            return NotImplemented

    stream = io.BytesIO()
    Tagged(stream).dump(pickle.loads(data))
    return stream.getvalue()


def test_tensors_saved_on_a_gpu_are_read(root: Path) -> None:
    before = load(root)
    path = hand_file(root)
    path.write_bytes(cuda_tagged(path.read_bytes()))
    assert b"cuda:0" in path.read_bytes()
    np.testing.assert_array_equal(load(root).hands["right"].hand_pose, before.hands["right"].hand_pose)


class Runs:
    def __reduce__(self):
        return print, ("code was run",)


def objects(root: Path) -> Path:
    return root / "Object_Poses" / NAMES[0]


def resave(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    np.save(path, change(np.load(path)))


SHIFT = np.float32([[0, 0, 0, 2], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no hand file": (lambda r: hand_file(r).unlink(), "right_hand.pkl: expected a file"),
    "no shape file": (lambda r: (r / "Hand_Poses" / NAMES[0] / "left_hand_shape.pkl").unlink(), "left_hand_shape.pkl"),
    "empty": (lambda r: hand_file(r).write_bytes(b""), "right_hand.pkl"),
    "truncated": (lambda r: hand_file(r).write_bytes(hand_file(r).read_bytes()[:-300]), "right_hand.pkl"),
    "runs code": (lambda r: dump(hand_file(r), Runs()), "print, which is not allowed"),
    "a list": (lambda r: dump(hand_file(r), [1, 2]), "expected a dictionary, got list"),
    "entry is a tensor": (
        lambda r: edit(hand_file(r), lambda p: p.update({"00003": p["00003"]["hand_pose"]})),
        "00003",
    ),
    "no translation": (lambda r: edit(hand_file(r), lambda p: p["00003"].pop("hand_trans")), "the entry 'hand_trans'"),
    "45 numbers": (
        lambda r: edit(hand_file(r), lambda p: p["00003"].update(hand_pose=torch.zeros(45))),
        "00003.hand_pose: expected an array of 48 columns",
    ),
    "text for numbers": (lambda r: edit(hand_file(r), lambda p: p["00003"].update(hand_pose="text")), "numbers"),
    "NaN": (lambda r: edit(hand_file(r), lambda p: p["00003"]["hand_pose"].fill_(np.nan)), "finite numbers"),
    "no tool": (
        lambda r: (objects(r) / "tool_012.npy").unlink(),
        r"tool_<id>.npy: expected poses of one object, got 0",
    ),
    "two tools": (lambda r: (objects(r) / "tool_013.npy").write_bytes(b""), "got 2: tool_012.npy, tool_013.npy"),
    "other count": (lambda r: resave(objects(r) / "target_105.npy", lambda p: p[:-1]), "30 frames as the tool, got 29"),
    "too many hands": (lambda r: resave(objects(r) / "tool_012.npy", lambda p: p[:-1]), "target: expected 29 frames"),
    "rows": (
        lambda r: resave(objects(r) / "tool_012.npy", lambda p: p.transpose(0, 2, 1)),
        "tool_012.npy/frame 0: expected a rotation and a shift",
    ),
    "mirror": (lambda r: resave(objects(r) / "tool_012.npy", lambda p: p * [[[-1], [1], [1], [1]]]), "a mirror"),
    "3x4": (lambda r: resave(objects(r) / "tool_012.npy", lambda p: p[:, :3]), r"of shape \(frames, 4, 4\)"),
    "objects": (lambda r: np.save(objects(r) / "tool_012.npy", np.array([None])), "tool_012.npy"),
    "no mesh": (lambda r: (r / "Object_Models" / "012_cm.obj").unlink(), "Object_Models/012_cm.obj"),
    "no touch": (
        lambda r: resave(objects(r) / "tool_012.npy", lambda p: p + SHIFT),
        "a hand within 2 cm of the tool",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_named_and_the_other_recordings_go_on(
    damage: str, root: Path, tmp_path: Path, capsys
) -> None:
    spoil, message = DAMAGES[damage]
    spoil(root)
    with pytest.raises(BadInput, match=message):
        load(root)
    summary = convert_dataset(TacoAdapter(), root, HANDS, tmp_path / "clips", progress=False)
    assert [item.source_key for item in summary.left_out] == [str(KEY)] or damage == "no mesh"
    assert "code was run" not in capsys.readouterr().out


def test_a_folder_that_is_no_triplet_is_refused_or_passed_over(root: Path) -> None:
    (root / "Hand_Poses" / "(brush, bowl)" / "20230927_001").mkdir(parents=True)
    (root / "Hand_Poses" / "notes" / "20230927_001").mkdir(parents=True)
    assert "taco/(brush, bowl)/20230927_001" in map(str, TacoAdapter().sequences(root))
    assert len(TacoAdapter().sequences(root)) == 4
    with pytest.raises(BadInput, match=r"\(action, tool, object\)"):
        triplet("(brush, bowl)/20230927_001")


def test_both_objects_and_the_words_survive_the_store(root: Path, tmp_path: Path) -> None:
    convert_dataset(TacoAdapter(), root, HANDS, tmp_path / "clips", progress=False)
    store = open_store(tmp_path / "clips")
    assert store.ids == [f"taco/{name}" for name in sorted(NAMES)]
    stored, clip = store.clip(f"taco/{NAMES[0]}"), load(root)
    assert [track.model.name for track in (stored.object, *stored.other_objects)] == ["012", "105"]
    np.testing.assert_array_equal(stored.other_objects[0].translation_m, clip.other_objects[0].translation_m)
    assert (stored.verb, stored.object_words, stored.gravity_note) == (clip.verb, clip.object_words, clip.gravity_note)
