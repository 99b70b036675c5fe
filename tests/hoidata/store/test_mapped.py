import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hoidata.errors import BadInput
from hoidata.files.arrays import write_npz
from hoidata.store.mapped import map_npz

ARRAYS = {
    "a/points": np.arange(12.0, dtype=np.float32).reshape(4, 3),
    "flags": np.array([True, False, True]),
    "empty": np.zeros((0, 45), np.float32),
    "scalar": np.array(7),
    "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)),
}


def test_mapped_arrays_equal_those_numpy_loads(tmp_path: Path):
    write_npz(tmp_path / "a.npz", ARRAYS)
    np.savez(tmp_path / "b.npz", **ARRAYS)
    for path in (tmp_path / "a.npz", tmp_path / "b.npz"):
        mapped = map_npz(path)
        with np.load(path) as loaded:
            assert sorted(mapped) == sorted(loaded.files)
            for name in loaded.files:
                np.testing.assert_array_equal(mapped[name], loaded[name])
                assert mapped[name].dtype == loaded[name].dtype


def test_mapped_arrays_cannot_be_changed(tmp_path: Path):
    write_npz(tmp_path / "a.npz", ARRAYS)
    with pytest.raises(ValueError, match="read-only"):
        map_npz(tmp_path / "a.npz")["a/points"][0] = 1


def test_files_that_cannot_be_mapped_are_named(tmp_path: Path):
    np.savez_compressed(tmp_path / "small.npz", a=np.zeros(100))
    np.savez(tmp_path / "objects.npz", a=np.array([{}], dtype=object))
    (tmp_path / "text.npz").write_text("hello")
    for name, got in (("small", "compressed"), ("objects", "Python objects"), ("text", "zip"), ("none", "nothing")):
        with pytest.raises(BadInput, match=got):
            map_npz(tmp_path / f"{name}.npz")


def test_a_header_that_promises_more_than_the_member_holds_is_refused(tmp_path: Path):
    """Otherwise the rows of the next member would be read as this one's."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in (("a", np.zeros((4, 3), np.float32)), ("b", np.ones((400, 3), np.float32))):
            stream = io.BytesIO()
            np.save(stream, array)
            archive.writestr(f"{name}.npy", stream.getvalue().replace(b"'shape': (4, 3)", b"'shape': (9, 3)"))
    with pytest.raises(BadInput, match="shorter than its shape"):
        map_npz(path)


def test_one_changed_byte_anywhere_in_an_array_is_told(tmp_path: Path):
    write_npz(tmp_path / "a.npz", {name: array for name, array in ARRAYS.items() if array.size})
    whole = (tmp_path / "a.npz").read_bytes()
    expected = {name: array.copy() for name, array in map_npz(tmp_path / "a.npz").items()}
    told = 0
    for place in range(0, len(whole), 7):
        changed = bytearray(whole)
        changed[place] ^= 1 << place % 8
        (tmp_path / f"{place}.npz").write_bytes(changed)
        try:
            found = map_npz(tmp_path / f"{place}.npz")
        except BadInput:
            told += 1
            continue
        # Bytes of the archive's own that nobody reads: times, versions, the lengths' second copies.
        assert {name: array.tolist() for name, array in found.items()} == {
            name: array.tolist() for name, array in expected.items()
        } or set(found) != set(expected)
    assert told > 0.6 * len(whole) / 7


def test_a_file_cut_anywhere_gives_the_named_error_only(tmp_path: Path):
    write_npz(tmp_path / "a.npz", ARRAYS)
    whole = (tmp_path / "a.npz").read_bytes()
    for length in range(0, len(whole), 37):
        (tmp_path / "cut.npz").write_bytes(whole[:length])
        with pytest.raises(BadInput, match=r"cut\.npz"):
            map_npz(tmp_path / "cut.npz")
