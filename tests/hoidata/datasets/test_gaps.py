"""Interpolation of short gaps in an object's poses: accuracy, marks and reports. Also the cache of meshes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import ObjectTrack
from hoidata.clips.validation import check_clip
from hoidata.datasets import known_meshes
from hoidata.datasets.base import RawTree
from hoidata.datasets.gaps import (
    MAX_BRIDGED_FRAMES,
    bridge,
    has_pose,
    mark_interpolated,
    missing_poses,
    trim_to_recorded,
)
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.errors import BadInput
from hoidata.objects.mesh import load_mesh

N_FRAMES = 40


def truth(model) -> ObjectTrack:
    """Cubic position, rotation at a constant rate through pi about a slanted axis, and a quadratic hinge angle."""
    time = np.linspace(0, 1, N_FRAMES)
    position_m = np.stack([time**3, 0.2 - time**2, 0.5 * time], axis=1)
    rotation = Rotation.from_rotvec(np.outer(2.5 + 1.5 * time, (0.6, 0.0, 0.8)))
    return ObjectTrack(model, rotation.as_rotvec(), position_m, time**2 if model.is_articulated else None)


def without(track: ObjectTrack, tracked: np.ndarray) -> ObjectTrack:
    """The track with wrong values in the frames without a pose."""
    corrupted = {name: np.where(tracked.reshape(-1, *[1] * (array.ndim - 1)), array, 9.0)
              for name in track.PER_FRAME if (array := getattr(track, name)) is not None}  # fmt: skip
    return replace(track, **corrupted)


def flags(*missing: int) -> np.ndarray:
    return ~np.isin(np.arange(N_FRAMES), missing)


@pytest.mark.parametrize("articulated", [False, True])
@pytest.mark.parametrize("missing", [(5,), (1, 38), (10, 11, 12), (19, 20, 23, 24), tuple(range(1, 39, 2))])
def test_interpolation_recovers_smooth_motion_in_short_gaps(
    make_clip, articulated: bool, missing: tuple[int, ...]
) -> None:
    whole, tracked = truth(make_clip(articulated=articulated).object.model), flags(*missing)
    interpolated = bridge(without(whole, tracked), tracked)
    assert np.abs(interpolated.translation_m - whole.translation_m).max() < 1e-4
    rotation_error = Rotation.from_rotvec(interpolated.rotvec) * Rotation.from_rotvec(whole.rotvec).inv()
    assert rotation_error.magnitude().max() < 1e-6
    assert np.linalg.norm(interpolated.rotvec, axis=1).max() <= np.pi + 1e-9
    if articulated:
        assert interpolated.hinge_rad == pytest.approx(whole.hinge_rad, abs=1e-6)


def test_four_frames_and_the_ends_are_not_bridged(make_clip) -> None:
    tracked = flags(0, 1, 10, 11, 12, 13, 38, 39)
    corrupted = without(truth(make_clip().object.model), tracked)
    interpolated = bridge(corrupted, tracked)
    assert np.array_equal(interpolated.translation_m, corrupted.translation_m)
    assert np.array_equal(has_pose(tracked), tracked)
    assert MAX_BRIDGED_FRAMES == 3


def test_interpolated_frames_have_the_number_of_the_recorded_frame_before_them(make_clip) -> None:
    recorded = np.array([True, False, False, True, True, False, True])
    numbers = mark_interpolated(np.array([20, 24, 28, 32, 36, 40, 44], np.int32), recorded)
    assert numbers.tolist() == [20, 20, 20, 32, 36, 36, 44]
    clip = make_clip().take(slice(0, 7))
    marked = check_clip(replace(clip, source_frames=numbers, source_fps=120.0))
    assert np.array_equal(marked.recorded, recorded)
    for wrong in (numbers[::-1], np.array([20, 24, 24, 25, 36, 40, 44], np.int32)):  # 25 is one frame after 24, not two
        with pytest.raises(BadInput, match="rising frame numbers"):
            check_clip(replace(clip, source_frames=wrong, source_fps=120.0))


def test_an_interval_is_trimmed_to_recorded_frames() -> None:
    recorded = flags(3, 4, 8, 9)
    assert trim_to_recorded((3, 10), recorded) == (5, 8)
    assert trim_to_recorded((3, 5), recorded) == (3, 3)


def test_long_gaps_are_reported_by_source_frames_and_untracked_ends_are_not_gaps() -> None:
    tracked, numbers = flags(0, 1, 2, 3, 4, 9, 12, 13, 14, 15, 30, 31, 32, 33, 34), 4 * np.arange(N_FRAMES)
    (reason,) = missing_poses("a/b/missing", "b.pkl", "the mug", numbers, tracked)
    assert reason.got == "none in source frames 48 to 60, 120 to 136"
    assert "poses of the mug" in reason.expected
    assert missing_poses("a/b/missing", "b.pkl", "the mug", numbers, flags(0, 1, 2, 3, 4, 9)) == []
    assert missing_poses("a/b/missing", "b.pkl", "the mug", numbers, np.zeros(N_FRAMES, bool)) == []


TRIANGLE = "v 0 0 0\nv {} 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the parsed files; the cache is empty at first."""
    names: list[str] = []

    def counted(path: Path):
        names.append(path.name)
        return load_mesh(path)

    monkeypatch.setattr(known_meshes, "_cache", type(known_meshes._cache)())
    monkeypatch.setattr(known_meshes, "load_mesh", counted)
    return names


def test_equal_files_are_parsed_once_and_each_is_recorded(tmp_path: Path, parsed: list[str]) -> None:
    for name in ("a.obj", "b.obj"):
        (tmp_path / name).write_text(TRIANGLE.format(1))
    raw = RawTree(tmp_path)
    first, second = raw_mesh(raw, "a.obj"), raw_mesh(raw, "b.obj")
    assert parsed == ["a.obj"]
    assert [source.path for source in raw.sources] == ["a.obj", "b.obj"]
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(second.faces, [[0, 1, 2]])


def test_the_caller_may_change_the_arrays(tmp_path: Path, parsed: list[str]) -> None:
    (tmp_path / "a.obj").write_text(TRIANGLE.format(1))
    changed = raw_mesh(RawTree(tmp_path), "a.obj")
    changed.vertices[:], changed.faces[:] = 7, 0
    again = raw_mesh(RawTree(tmp_path), "a.obj")
    np.testing.assert_array_equal(again.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(again.faces, [[0, 1, 2]])


def test_a_file_that_changes_or_breaks_is_read_again(tmp_path: Path, parsed: list[str]) -> None:
    (tmp_path / "a.obj").write_text(TRIANGLE.format(1))
    raw_mesh(RawTree(tmp_path), "a.obj")
    (tmp_path / "a.obj").write_text(TRIANGLE.format(2))
    assert raw_mesh(RawTree(tmp_path), "a.obj").vertices.max() == 2
    (tmp_path / "a.obj").write_text(TRIANGLE.format("x"))
    for _ in range(2):
        with pytest.raises(BadInput, match="numbers after 'v' or 'f'"):
            raw_mesh(RawTree(tmp_path), "a.obj")


def test_the_same_bytes_under_another_ending_are_another_format(tmp_path: Path, parsed: list[str]) -> None:
    for name in ("a.obj", "a.ply"):
        (tmp_path / name).write_text(TRIANGLE.format(1))
    raw_mesh(RawTree(tmp_path), "a.obj")
    with pytest.raises(BadInput, match="readable mesh"):
        raw_mesh(RawTree(tmp_path), "a.ply")


def test_the_least_recently_used_mesh_is_dropped_first(
    tmp_path: Path, parsed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known_meshes, "MAX_CACHE_BYTES", 2 * (9 * 8 + 3 * 8))
    for number in (1, 2, 3):
        (tmp_path / f"{number}.obj").write_text(TRIANGLE.format(number))
    raw = RawTree(tmp_path)
    for number in (1, 2, 1, 3, 1, 2):
        assert raw_mesh(raw, f"{number}.obj").vertices.max() == max(number, 1)
    assert parsed == ["1.obj", "2.obj", "3.obj", "2.obj"]
