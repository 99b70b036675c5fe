import io
import json
import pickle
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load, save

from hoidata.errors import BadInput
from hoidata.files import load_npy, load_npy_object, load_npz_objects
from hoidata.files.arrays import read_npz, write_npz
from hoidata.files.atomic import canonical_json, sha256_bytes
from hoidata.files.checksums import (
    EMPTY_CHECKSUMS,
    corrupted_part,
    payload_digest,
    read_metadata,
    sealed,
    verify_checksums,
)
from hoidata.files.npy_header import read_npy_header
from hoidata.files.numpy_files import load_npz_arrays
from tests.hoidata.files.test_restricted_pickle import Call


def npy_of_numpy_1(value):
    """The bytes numpy 1.23 writes for a 0-d object array: header 1.0, pickle protocol 3, old module names."""
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    padded = header + b" " * (64 - (10 + len(header) + 1) % 64) + b"\n"
    body = pickle.dumps(np.array(value, dtype=object), 3).replace(b"numpy._core", b"numpy.core")
    assert b"numpy.core.multiarray" in body
    return b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded + body


ARCTIC = {"right": {"rot": np.arange(6.0).reshape(2, 3), "shape": np.zeros(10), "fitting_err": [0.1, 0.2]}}


def test_a_dict_saved_by_numpy_1_or_2_round_trips(tmp_path):
    (tmp_path / "old.npy").write_bytes(npy_of_numpy_1(ARCTIC))
    np.save(tmp_path / "new.npy", np.array(ARCTIC, dtype=object), allow_pickle=True)
    for name in ("old.npy", "new.npy"):
        loaded = load_npy_object(tmp_path / name)
        np.testing.assert_array_equal(loaded["right"]["rot"], ARCTIC["right"]["rot"])
        assert loaded["right"]["fitting_err"] == [0.1, 0.2]


def test_both_readers_load_plain_arrays(tmp_path):
    for array in (np.eye(3), np.asfortranarray(np.arange(6).reshape(2, 3)), np.array(["a", "bc"]), np.zeros((0, 7))):
        np.save(tmp_path / "a.npy", array)
        np.testing.assert_array_equal(load_npy(tmp_path / "a.npy"), array)
        np.testing.assert_array_equal(load_npy_object(tmp_path / "a.npy"), array)


def test_the_plain_reader_refuses_objects(tmp_path):
    (tmp_path / "a.npy").write_bytes(npy_of_numpy_1(ARCTIC))
    with pytest.raises(BadInput, match=r"a\.npy: expected an array of numbers, got Python objects"):
        load_npy(tmp_path / "a.npy")


def grab(path):
    np.savez(
        path,
        gender="male",
        n_frames=np.int64(240),
        framerate=120.0,
        body={"params": {"transl": np.ones((2, 3))}},
        contact={"object": np.zeros((2, 5), dtype=np.int8)},
        plain=np.arange(3),
    )


def test_grab_members_are_loaded_as_items(tmp_path):
    grab(tmp_path / "s.npz")
    loaded = load_npz_objects(tmp_path / "s.npz")
    assert (loaded["gender"], loaded["n_frames"], loaded["framerate"]) == ("male", 240, 120.0)
    np.testing.assert_array_equal(loaded["body"]["params"]["transl"], np.ones((2, 3)))
    np.testing.assert_array_equal(loaded["plain"], np.arange(3))


def test_only_the_named_members_are_read_and_must_exist(tmp_path):
    grab(tmp_path / "s.npz")
    assert set(load_npz_objects(tmp_path / "s.npz", {"gender", "body"})) == {"gender", "body"}
    with pytest.raises(BadInput, match="lhand"):
        load_npz_objects(tmp_path / "s.npz", {"lhand"})


@pytest.mark.parametrize("reader", [load_npy, load_npy_object])
def test_npy_with_a_call_inside_is_refused_and_nothing_runs(tmp_path, reader):
    trace = tmp_path / "trace"
    np.save(tmp_path / "a.npy", np.array({"a": Call(open, str(trace), "w")}, dtype=object), allow_pickle=True)
    with pytest.raises(BadInput):
        reader(tmp_path / "a.npy")
    assert not trace.exists()


def test_npz_with_a_call_inside_is_refused_by_member_and_nothing_runs(tmp_path):
    trace = tmp_path / "trace"
    np.savez(tmp_path / "a.npz", body=np.array({"a": Call(open, str(trace), "w")}, dtype=object))
    with pytest.raises(BadInput, match=r"a\.npz: body: .*open"):
        load_npz_objects(tmp_path / "a.npz")
    assert not trace.exists()


def test_zip_bomb_is_refused_by_its_declared_size(tmp_path, monkeypatch):
    monkeypatch.setattr("hoidata.files.numpy_files._MAX_BYTES", 10_000)
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(100_000))
    with pytest.raises(BadInput, match="at most 10000 bytes"):
        load_npz_objects(tmp_path / "a.npz")


def test_too_many_members_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for index in range(300):
            archive.writestr(f"{index}.npy", b"")
    with pytest.raises(BadInput, match="at most 256 members"):
        load_npz_objects(tmp_path / "a.npz")


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_truncated_files_are_bad_input(tmp_path, fraction):
    grab(tmp_path / "s.npz")
    np.save(tmp_path / "plain.npy", np.arange(1000))
    (tmp_path / "object.npy").write_bytes(npy_of_numpy_1(ARCTIC))
    readers = {"s.npz": load_npz_objects, "plain.npy": load_npy, "object.npy": load_npy_object}
    for name, reader in readers.items():
        path = tmp_path / name
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * fraction)])
        with pytest.raises(BadInput, match=name):
            reader(path)


def test_a_spoilt_member_is_bad_input(tmp_path):
    grab(tmp_path / "s.npz")
    data = bytearray((tmp_path / "s.npz").read_bytes())
    data[data.find(b"transl") + 80] ^= 0xFF
    (tmp_path / "s.npz").write_bytes(bytes(data))
    with pytest.raises(BadInput, match=r"s\.npz"):
        load_npz_objects(tmp_path / "s.npz")


@pytest.mark.parametrize("reader", [load_npy, load_npy_object, load_npz_objects])
def test_a_missing_file_or_a_folder_is_bad_input(tmp_path, reader):
    for path in (tmp_path / "nothing.npy", tmp_path):
        with pytest.raises(BadInput, match=str(path)):
            reader(path)


@pytest.mark.parametrize("reader", [load_npz_arrays, load_npz_objects])
@pytest.mark.parametrize("pickled", [False, True])
def test_an_archive_may_unpack_to_eight_times_its_size(tmp_path, monkeypatch, reader, pickled):
    """Recorded numbers shrink to a half; a megabyte of zeros, which unpacks to a gigabyte, is not a recording."""
    if pickled and reader is load_npz_arrays:
        pytest.skip("it reads no objects")
    monkeypatch.setattr("hoidata.files.numpy_files._FREE_BYTES", 1000)
    recorded, zeros = np.random.default_rng(0).normal(size=(300, 99)).astype(np.float32), np.zeros((3000, 99))
    for name, array in (("recorded", recorded), ("zeros", zeros)):
        np.savez_compressed(tmp_path / f"{name}.npz", a=np.array({"x": array}, dtype=object) if pickled else array)
        np.savez(tmp_path / f"{name}-stored.npz", a=np.array({"x": array}, dtype=object) if pickled else array)
    for name in ("recorded", "recorded-stored", "zeros-stored"):
        array = reader(tmp_path / f"{name}.npz")["a"]
        np.testing.assert_array_equal(array["x"] if pickled else array, zeros if "zeros" in name else recorded)
    with pytest.raises(BadInput, match=r"when unpacked, got \d+; download it again, or store it uncompressed"):
        reader(tmp_path / "zeros.npz")


def test_the_pickles_of_one_archive_share_a_limit_of_opcodes(tmp_path, monkeypatch):
    monkeypatch.setattr("hoidata.files.pickle_check._MAX_OPCODES", 700)
    members = {f"m{number}": np.array([[1] * 40], dtype=object) for number in range(10)}
    for count in (4, 10):
        np.savez_compressed(tmp_path / "a.npz", **dict(list(members.items())[:count]))
        if count == 4:
            assert len(load_npz_objects(tmp_path / "a.npz")) == 4
    with pytest.raises(BadInput, match="more than 700 opcodes"):
        load_npz_objects(tmp_path / "a.npz")


ARRAYS = {
    "points": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    "number": np.array(7, np.int16),
    "words": np.array(["a", "longer"]),
    "none": np.zeros((0, 3), np.float32),
}


def test_arrays_keep_their_shape_and_type(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", ARRAYS)
    arrays = read_npz(tmp_path / "a.npz")
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert (arrays[name].shape, arrays[name].dtype) == (array.shape, array.dtype)
        np.testing.assert_array_equal(arrays[name], array)


def test_equal_arrays_give_equal_bytes_that_are_not_compressed(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", ARRAYS)
    write_npz(tmp_path / "b.npz", {name: array.copy(order="C") for name, array in ARRAYS.items()})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {item.compress_type for item in archive.infolist()} == {zipfile.ZIP_STORED}


def test_the_bytes_are_those_of_numpy_on_a_python_after_3_11_3(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", {"number": ARRAYS["number"]})
    data = (tmp_path / "a.npz").read_bytes()
    # Signature, version 4.5, no flags, stored, 1 January 1980 at midnight, checksum, 2 x 32 bits of ones; the name has
    # 10 letters, the extra field 20 bytes: its number 1, 16 bytes that follow, and the size twice in 64 bits.
    assert data[:14] == b"PK\x03\x04" + bytes([45, 0, 0, 0, 0, 0, 0, 0, 33, 0])
    assert data[18:40] == b"\xff" * 8 + bytes([10, 0, 20, 0]) + b"number.npy"
    assert data[40:60] == bytes([1, 0, 16, 0]) + (130).to_bytes(8, "little") * 2
    if sys.version_info >= (3, 11, 4):
        np.savez(tmp_path / "b.npz", allow_pickle=False, number=ARRAYS["number"])
        assert data == (tmp_path / "b.npz").read_bytes()


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


def file_of(header: str, body: bytes = b"", version: int = 1) -> bytes:
    size = len(header).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes((version, 0)) + size + header.encode("latin1") + body


def head(shape: str = "(2,)", descr: str = "'<f8'", order: str = "False") -> str:
    return f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n"


@pytest.mark.parametrize("version", [1, 2, 3])
@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(24, dtype=">i2").reshape(2, 3, 4)),
        np.array("wörter"),
        np.array([b"ab", b"c"]),
        np.array([[True], [False]]),
        np.zeros((0, 3), np.float32),
        np.array(2.5),
    ],
    ids=["c", "fortran", "text", "bytes", "flags", "empty", "scalar"],
)
def test_files_saved_by_numpy_give_equal_writable_arrays(tmp_path, array, version):
    with open(tmp_path / "a.npy", "wb") as stream:
        np.lib.format.write_array(stream, array, version=(version, 0))
    loaded = load_npy(tmp_path / "a.npy")
    np.testing.assert_array_equal(loaded, array, strict=True)
    loaded[...] = loaded[...]


def test_a_header_of_python_2_is_read():
    assert read_npy_header(io.BytesIO(file_of(head("(3L, 4L)"))), "a.npy").shape == (3, 4)


@pytest.mark.parametrize(
    "text",
    [
        head("(3"),
        head("(-1,)"),
        head("(1.5,)"),
        head("(True,)"),
        head("5"),
        head("(9999999999999999999999,)"),
        head("(" + "1," * 33 + ")"),
        head(descr="()"),
        head(descr="[('a', '<f8')]"),
        head(descr="'V8'"),
        head(descr="'<M8[s]'"),
        head(descr="'<f8', 5"),
        head(order="1"),
        "{'descr': '<f8', 'shape': ()}",
        "{'descr': '<f8', 'shape': (), 'fortran_order': False, 'more': 1}",
        "__import__('os').system('true')",
        "(" * 200 + ")" * 200,
        "'''",
        "\0",
        "",
        " " * 20000,
    ],
    ids=range(21),
)
@pytest.mark.parametrize("load", [load_npy, load_npy_object])
def test_a_damaged_header_is_a_bad_input(tmp_path, text, load):
    """NumPy's reader answers these with seven kinds of error, from TokenError to MemoryError."""
    (tmp_path / "a.npy").write_bytes(file_of(text, bytes(16)))
    with pytest.raises(BadInput, match=r"a\.npy: expected"):
        load(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", ["(1000000000, 1000000000)", "(100000000000,)", "(0, 200000000000000, 100000)"])
def test_no_shape_is_allocated_before_there_are_bytes_for_it(tmp_path, shape):
    (tmp_path / "a.npy").write_bytes(file_of(head(shape), bytes(16)))
    with pytest.raises(BadInput, match="shape"):
        load_npy(tmp_path / "a.npy")


def test_text_of_impossible_characters_is_refused(tmp_path):
    for order in "<>":
        (tmp_path / "a.npy").write_bytes(file_of(head("()", f"'{order}U1'"), b"\x7f\xff\xff\x7f"))
        with pytest.raises(BadInput, match="impossible characters"):
            load_npy_object(tmp_path / "a.npy")


TENSORS = {"weight": np.arange(3, dtype=np.float32)}


def stored(tmp_path, **info):
    path = tmp_path / "model.safetensors"
    path.write_bytes(sealed(save(TENSORS, {"hoidata": canonical_json({"model": "toy", **info})})))
    return path


def test_a_sealed_file_is_whole_and_reads_as_any_safetensors_file(tmp_path):
    path = stored(tmp_path, seal=EMPTY_CHECKSUMS)
    assert corrupted_part(path) is None
    verify_checksums(path)
    assert load(path.read_bytes())["weight"].tolist() == [0, 1, 2]
    assert (
        read_metadata(path)["seal"]["payload_sha256"] == payload_digest(path) == sha256_bytes(path.read_bytes()[-12:])
    )


def test_a_flipped_bit_is_detected_and_assigned_to_its_half_of_the_file(tmp_path):
    path = stored(tmp_path, seal=EMPTY_CHECKSUMS)
    whole = path.read_bytes()
    start = 8 + int.from_bytes(whole[:8], "little")
    for number in range(len(whole)):
        damaged = bytearray(whole)
        damaged[number] ^= 1 << number % 8
        path.write_bytes(damaged)
        try:
            fault = corrupted_part(path)
        except BadInput:
            fault = "header"  # no longer the header of a checkpoint
        # A flipped digest of the weights counts as corrupted weights, because the two cases are indistinguishable.
        assert fault == "weights" if number >= start else fault in ("header", "weights"), number


def test_a_file_written_before_there_were_seals_is_not_accused(tmp_path):
    assert corrupted_part(stored(tmp_path)) is None


def test_a_broken_seal_is_refused_with_the_half_that_was_changed(tmp_path):
    path = stored(tmp_path, seal=EMPTY_CHECKSUMS)
    path.write_bytes(path.read_bytes()[:-1] + b"\xff")
    with pytest.raises(BadInput, match="expected weights matching the checksum"):
        verify_checksums(path)


def test_metadata_other_than_an_object_is_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(save(TENSORS, {"hoidata": json.dumps([1])}))
    with pytest.raises(BadInput, match="provenance"):
        read_metadata(path)
