"""NPZ files of ours: equal arrays give equal bytes, nothing is pickled, bad files are named."""

import sys
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


def test_the_bytes_are_those_of_numpy_on_a_python_after_3_11_3(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", {"number": ARRAYS["number"]})
    found = (tmp_path / "a.npz").read_bytes()
    # Signature, version 4.5, no flags, stored, 1 January 1980 at midnight, checksum, 2 x 32 bits of ones; the name has
    # 10 letters, the extra field 20 bytes: its number 1, 16 bytes that follow, and the size twice in 64 bits.
    assert found[:14] == b"PK\x03\x04" + bytes([45, 0, 0, 0, 0, 0, 0, 0, 33, 0])
    assert found[18:40] == b"\xff" * 8 + bytes([10, 0, 20, 0]) + b"number.npy"
    assert found[40:60] == bytes([1, 0, 16, 0]) + (130).to_bytes(8, "little") * 2
    if sys.version_info >= (3, 11, 4):
        np.savez(tmp_path / "b.npz", allow_pickle=False, number=ARRAYS["number"])
        assert found == (tmp_path / "b.npz").read_bytes()


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
