"""NPZ files of ours: equal arrays give equal bytes, nothing is pickled, bad files are named."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from hoidata.errors import BadInput
from hoidata.files.arrays import read_npz, write_npz

ARRAYS = {
    "points": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    "number": np.array(7, np.int16),
    "words": np.array(["a", "longer"]),
    "none": np.zeros((0, 3), np.float32),
}


def test_arrays_come_back_with_their_shape_and_type(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", ARRAYS)
    found = read_npz(tmp_path / "a.npz")
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (found[name].shape, found[name].dtype) == (array.shape, array.dtype)
        np.testing.assert_array_equal(found[name], array)


def test_equal_arrays_give_equal_bytes_that_are_not_compressed(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", ARRAYS)
    write_npz(tmp_path / "b.npz", {name: array.copy(order="C") for name, array in ARRAYS.items()})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {item.compress_type for item in archive.infolist()} == {zipfile.ZIP_STORED}


def test_python_objects_are_neither_written_nor_read(tmp_path: Path) -> None:
    objects = np.array([{"a": 1}], dtype=object)
    with pytest.raises(ValueError, match="holds Python objects"):
        write_npz(tmp_path / "a.npz", {"bad": objects})
    assert not (tmp_path / "a.npz").exists()
    np.savez(tmp_path / "b.npz", bad=objects)
    with pytest.raises(BadInput, match=r"b\.npz"):
        read_npz(tmp_path / "b.npz")


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut short"])
def test_a_broken_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(BadInput, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="nothing"):
        read_npz(tmp_path / "a.npz")
