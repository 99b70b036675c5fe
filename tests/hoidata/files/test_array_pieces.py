"""Large arrays inside pickled .npz members: read in pieces, equal to what was written, and nothing executed."""

import io
import os
import pickle
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hoidata.errors import BadInput
from hoidata.files.array_pieces import locate_arrays, npz_members
from tests.hoidata.files.test_restricted_pickle import Call


def save(path: Path, content, protocol: int = 3, old_names: bool = False) -> Path:
    """``content`` as the 0-d object member "contact", pickled as NumPy would."""
    boxed = np.empty((), dtype=object)
    boxed[()] = content
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
    pickled = pickle.dumps(boxed, protocol=protocol)
    return save_bytes(
        path, stream.getvalue() + (pickled.replace(b"numpy._core.", b"numpy.core.") if old_names else pickled)
    )


def save_bytes(path: Path, member: bytes, name: str = "contact.npy") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, member)
    return path


def whole(stored) -> np.ndarray:
    parts = [piece for _, piece in stored.pieces()]
    rows = np.concatenate(parts) if parts else np.zeros((0, 0))
    return rows.T if stored.by_columns else rows


@pytest.mark.parametrize("dtype", ["int8", "uint8", "<i2", ">i4", "<i8", "<f4", ">f8", "bool"])
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_arrays_of_all_types_and_pickle_versions_round_trip(tmp_path, dtype, protocol):
    small, large = np.arange(12).reshape(3, 4).astype(dtype), (np.arange(30_000) % 56).reshape(300, 100).astype(dtype)
    arrays = locate_arrays(save(tmp_path / "a.npz", {"object": large, "body": small}, protocol), "contact")
    assert sorted(arrays) == ["body", "object"]
    np.testing.assert_array_equal(whole(arrays["object"]), large)
    np.testing.assert_array_equal(whole(arrays["body"]), small)
    assert arrays["object"].shape == (300, 100)
    assert arrays["object"].dtype == np.dtype(dtype)


def test_bytes_written_as_text_round_trip(tmp_path):
    values = np.random.default_rng(0).normal(size=(700, 400)) * 1e9  # 2.2 MB; half of the bytes take two of UTF-8
    stored = locate_arrays(save(tmp_path / "a.npz", {"object": values}, protocol=2), "contact")["object"]
    np.testing.assert_array_equal(whole(stored), values)


@pytest.mark.parametrize("old_names", [False, True])
def test_files_of_numpy_1_and_2_are_read(tmp_path, old_names):
    values = np.arange(9000).reshape(90, 100)
    path = save(tmp_path / "a.npz", {"object": values}, protocol=3, old_names=old_names)
    np.testing.assert_array_equal(whole(locate_arrays(path, "contact")["object"]), values)


@pytest.mark.parametrize("protocol", [3, 5])
def test_arrays_stored_column_by_column_come_as_columns(tmp_path, protocol):
    values = np.asfortranarray(np.arange(9000).reshape(90, 100))
    stored = locate_arrays(save(tmp_path / "a.npz", {"object": values}, protocol), "contact")["object"]
    assert stored.by_columns
    np.testing.assert_array_equal(whole(stored), values)


def test_files_saved_by_numpy_are_read_and_other_entries_are_skipped(tmp_path):
    values = np.arange(20_000).reshape(100, 200)
    content = {"object": values, "note": "a text", "list": [1, 2], "n": np.float64(3)}
    np.savez_compressed(tmp_path / "a.npz", contact=np.array(content, dtype=object), other=np.arange(3))
    assert npz_members(tmp_path / "a.npz") == {"contact", "other"}
    arrays = locate_arrays(tmp_path / "a.npz", "contact")
    assert list(arrays) == ["object"]
    np.testing.assert_array_equal(whole(arrays["object"]), values)


def test_pieces_say_which_row_they_start_at_and_memory_stays_small(tmp_path):
    values = np.zeros((2500, 4000), np.int64)  # 80 MB
    values[::3, ::5] = 7
    stored = locate_arrays(save(tmp_path / "a.npz", {"object": values}), "contact")["object"]
    tracemalloc.start()
    total = 0
    for first, piece in stored.pieces():
        np.testing.assert_array_equal(piece, values[first : first + len(piece)])
        total += len(piece)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert total == 2500
    assert peak < 30e6


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("inside", [True, False])
def test_a_pickle_with_a_call_is_refused_and_executes_nothing(tmp_path, protocol, inside):
    marker, values = tmp_path / "ran", np.zeros((100, 100))
    call = Call(os.mkdir, str(marker))
    content = {"object": values, "extra": call} if inside else call
    with pytest.raises(BadInput) as caught:
        locate_arrays(save(tmp_path / "a.npz", content, protocol), "contact")
    assert "not allowed" in caught.value.got
    assert not marker.exists()


def _header(descr: str = "|O", shape: tuple = ()) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def _array_of_shape(shape: str, data: int) -> bytes:
    """A pickled dict with one array that states a shape and has so many bytes."""
    array = (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\nt" + b"C\x01bt" + b"R(I1\n" + shape.encode()
        + b"cnumpy\ndtype\n(X\x02\x00\x00\x00i1I0\nI1\ntR(I3\nX\x01\x00\x00\x00|NNNI-1\nI-1\nI0\ntb" + b"I00\n"
        + b"B" + data.to_bytes(4, "little") + bytes(data) + b"tb"
    )  # fmt: skip
    boxed = (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\nt" + b"C\x01bt" + b"R(I1\n)"
        + b"cnumpy\ndtype\n(X\x02\x00\x00\x00O8I0\nI1\ntR(I3\nX\x01\x00\x00\x00|NNNI-1\nI-1\nI63\ntb" + b"I00\n"
        + b"(l(dX\x06\x00\x00\x00object" + array + b"satb."
    )  # fmt: skip
    return _header() + b"\x80\x03" + boxed


BROKEN = {
    "no pickle": (_header() + b"nothing at all", "pickle"),
    "an empty member": (b"", "NumPy file"),
    "no header": (b"\x80\x03}.", "NumPy file"),
    "a pickle cut short": (_header() + pickle.dumps(np.zeros((100, 100)), 3)[:5000], ".npz"),
    "plain numbers": (_header("<i8", (4,)) + bytes(32), "dict of arrays"),
    "a list in the place of the dict": (_header() + b"\x80\x03]q\x00.", "dict of arrays"),
    "a string longer than the file": (_header() + b"\x80\x03B\xff\xff\xff\xff", ".npz"),
    "a string longer than any memory": (_header() + b"\x80\x04\x8e" + b"\xff" * 7 + b"\x7f", ".npz"),
    "a text longer than any memory": (_header() + b"\x80\x04\x8d" + b"\xff" * 7 + b"\x7f", ".npz"),
    "more opcodes than a dict of arrays needs": (_header() + b"\x80\x03" + b"N0" * 700_000 + b"}.", ".npz"),
    "a line without end": (_header() + b"c" + b"x" * 3_000_000, ".npz"),
    "an unknown opcode": (_header() + b"\x80\x03\xff.", "pickle"),
    "a shape the data do not fill": (_array_of_shape("(I10\nI20\nt", 199), "200 bytes"),
    "a shape beyond any memory": (_array_of_shape("(L1000000000000L\nL1000000000000L\nt", 100), "bytes for shape"),
    "a negative shape": (_array_of_shape("(I-1\nI-1\nt", 1), "rows and columns"),
    "three axes": (_array_of_shape("(I1\nI2\nI3\nt", 6), "rows and columns"),
    "a shape of text": (_array_of_shape("(Vx\nI2\nt", 6), "rows and columns"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_member_is_named_and_costs_no_memory(tmp_path, name):
    member, expected = BROKEN[name]
    path = save_bytes(tmp_path / "a.npz", member)
    tracemalloc.start()
    with pytest.raises(BadInput) as caught:
        locate_arrays(path, "contact")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert expected in caught.value.expected
    assert "a.npz" in caught.value.where
    assert peak < 50e6


def test_the_hand_made_pickle_is_a_good_one_when_its_shape_fits(tmp_path):
    path = save_bytes(tmp_path / "a.npz", _array_of_shape("(I10\nI20\nt", 200))
    assert whole(locate_arrays(path, "contact")["object"]).shape == (10, 20)


def test_an_archive_that_is_none_or_lacks_the_member_is_named(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK no archive")
    save_bytes(tmp_path / "b.npz", b"", name="other.npy")
    for name, expected in (("a.npz", "a whole .npz file"), ("b.npz", "a member 'contact'"), ("c.npz", "a whole .npz")):
        with pytest.raises(BadInput) as caught:
            locate_arrays(tmp_path / name, "contact")
        assert expected in caught.value.expected


def test_damage_in_the_middle_of_the_data_is_detected(tmp_path):
    values = np.random.default_rng(0).integers(0, 255, (500, 500), dtype=np.uint8)
    path = save(tmp_path / "a.npz", {"object": values})
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(BadInput):
        locate_arrays(path, "contact")


def test_too_many_members_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for number in range(257):
            archive.writestr(f"m{number}.npy", b"")
    with pytest.raises(BadInput) as caught:
        npz_members(tmp_path / "a.npz")
    assert "256" in caught.value.expected
