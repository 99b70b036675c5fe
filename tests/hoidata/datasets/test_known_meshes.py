"""Meshes that are parsed once: equal content is known again, changed content is not taken for the old."""

from pathlib import Path

import numpy as np
import pytest

from hoidata.datasets import known_meshes
from hoidata.datasets.base import RawTree
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.errors import BadInput
from hoidata.objects.mesh import load_mesh

TRIANGLE = "v 0 0 0\nv {} 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the files that were really parsed, from an empty memory on."""
    names: list[str] = []

    def counted(path: Path):
        names.append(path.name)
        return load_mesh(path)

    monkeypatch.setattr(known_meshes, "_known", type(known_meshes._known)())
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


def test_arrays_belong_to_the_caller(tmp_path: Path, parsed: list[str]) -> None:
    (tmp_path / "a.obj").write_text(TRIANGLE.format(1))
    given = raw_mesh(RawTree(tmp_path), "a.obj")
    given.vertices[:], given.faces[:] = 7, 0
    again = raw_mesh(RawTree(tmp_path), "a.obj")
    np.testing.assert_array_equal(again.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(again.faces, [[0, 1, 2]])


def test_a_file_that_changes_or_breaks_is_read_anew(tmp_path: Path, parsed: list[str]) -> None:
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


def test_the_mesh_used_longest_ago_is_forgotten_first(
    tmp_path: Path, parsed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known_meshes, "MOST_BYTES", 2 * (9 * 8 + 3 * 8))
    for number in (1, 2, 3):
        (tmp_path / f"{number}.obj").write_text(TRIANGLE.format(number))
    raw = RawTree(tmp_path)
    for number in (1, 2, 1, 3, 1, 2):
        assert raw_mesh(raw, f"{number}.obj").vertices.max() == max(number, 1)
    assert parsed == ["1.obj", "2.obj", "3.obj", "2.obj"]
