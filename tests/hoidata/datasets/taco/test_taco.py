"""TACO's adapter on files written here: pickles of torch tensors, OBJ in centimetres."""

import io
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.annotation.sentences import english_sentences
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.validation import check_clip
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import Quarantined, RawTree
from hoidata.datasets.taco.adapter import TacoAdapter, frames_by_side, triplet
from hoidata.errors import BadInput, RawFileChanged
from hoidata.store.store import open_store
from tests.builders.taco import HANDS, KEY, N_FRAMES, NAMES, dump, write_taco


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
    assert english_sentences(verb, noun, "right")[0] == "Put in a spoon with the right hand."


def test_a_clip_names_its_eight_source_files(root: Path) -> None:
    hands = [f"Hand_Poses/{NAMES[0]}/{side}_hand{kind}.pkl" for side in SIDES for kind in ("", "_shape")]
    objects = [f"Object_Poses/{NAMES[0]}/{name}.npy" for name in ("target_105", "tool_012")]
    models = [f"Object_Models/{name}_cm.obj" for name in ("012", "105")]
    assert [source.path for source in load(root).sources] == sorted(hands + objects + models)


def test_a_missing_shape_file_gives_zero_betas_as_in_the_authors_loader_and_is_reported(root: Path) -> None:
    path = hand_file(root, "left").with_name("left_hand_shape.pkl")
    whole = load(root)
    path.unlink()
    clip, reason = TacoAdapter().load(RawTree(root), KEY, HANDS)
    assert isinstance(clip, Clip)
    np.testing.assert_array_equal(check_clip(clip).hands["left"].betas, np.zeros((1, 10)))
    np.testing.assert_array_equal(clip.hands["right"].betas, whole.hands["right"].betas)
    assert whole.hands["right"].betas.any()
    assert clip.gravity_note.endswith("; no left_hand_shape.pkl: its betas are zero, as in TACO's own loader")
    assert "betas" not in whole.gravity_note
    assert isinstance(reason, Quarantined)
    assert reason.where.endswith("left_hand_shape.pkl")
    assert "the clip has zero betas" in reason.remedy


def test_a_shape_file_that_the_manifest_lists_and_that_is_gone_is_an_error(root: Path) -> None:
    raw = RawTree(root)
    TacoAdapter().load(raw, KEY, HANDS)
    hand_file(root, "left").with_name("left_hand_shape.pkl").unlink()
    with pytest.raises(RawFileChanged, match=r"left_hand_shape\.pkl"):
        TacoAdapter().load(RawTree(root, {source.path: source for source in raw.sources}), KEY, HANDS)


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
    placed = frames_by_side("triplet/recording", {"left": left, "right": right}, 3)["right"]
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
        frames_by_side("triplet/recording", {"left": left, "right": right}, 3)


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
