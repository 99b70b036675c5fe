import io
import os
import pickle
import pickletools
import subprocess
import sys
from collections import OrderedDict

import numpy as np
import pytest
import torch

from hoidata.errors import BadInput
from hoidata.files import load_torch_pickle, torch_pickle
from tests.hoidata.files.test_restricted_pickle import Call


def hand_file():
    """As TACO's: frame -> pose and translation."""
    return {f"{frame:05d}": {"hand_pose": torch.randn(48), "hand_trans": torch.randn(3)} for frame in range(3)}


def cuda_tagged(data: bytes) -> bytes:
    """The bytes a tensor on a GPU has: only the location in its storage's persistent id differs (protocol 3)."""
    cpu, cuda = b"X\x03\x00\x00\x00cpu", b"X\x06\x00\x00\x00cuda:0"
    patched, offset = bytearray(), 0
    for blob, at in _blobs(data):
        new = blob.replace(cpu, cuda)
        assert cuda in new
        patched += data[offset:at] + b"B" + len(new).to_bytes(4, "little") + new
        offset = at + 5 + len(blob)
    return bytes(patched + data[offset:])


def _blobs(data: bytes):
    """The bytes of each storage, and where its opcode stands."""
    for opcode, argument, at in pickletools.genops(data):
        if opcode.name == "BINBYTES":
            yield argument, at


def test_tensors_inside_containers_become_separate_writable_arrays(tmp_path):
    content = {
        "hands": hand_file(),
        "ordered": OrderedDict(b=torch.arange(6).reshape(2, 3).T, a=(torch.tensor(2.5, dtype=torch.float64), "text")),
        "list": [torch.tensor([True, False]), torch.zeros(0, 3), 1, None],
        "slice": torch.arange(20, dtype=torch.int16)[4:16:3],
        "parameter": torch.nn.Parameter(torch.ones(2, 2)),
        "repeated": torch.tensor([7], dtype=torch.uint8).expand(5),
    }
    (tmp_path / "hand.pkl").write_bytes(pickle.dumps(content))
    loaded = load_torch_pickle(tmp_path / "hand.pkl", "hand.pkl")
    for frame, values in content["hands"].items():
        for name, tensor in values.items():
            np.testing.assert_array_equal(loaded["hands"][frame][name], tensor.numpy(), strict=True)
    np.testing.assert_array_equal(loaded["ordered"]["b"], [[0, 3], [1, 4], [2, 5]])
    assert list(loaded["ordered"]) == ["b", "a"]
    assert loaded["ordered"]["a"][0].shape == ()
    assert loaded["ordered"]["a"][0] == 2.5
    np.testing.assert_array_equal(loaded["list"][0], np.array([True, False]), strict=True)
    assert loaded["list"][1].shape == (0, 3)
    np.testing.assert_array_equal(loaded["slice"], np.array([4, 7, 10, 13], np.int16), strict=True)
    np.testing.assert_array_equal(loaded["parameter"], np.ones((2, 2), np.float32), strict=True)
    np.testing.assert_array_equal(loaded["repeated"], np.full(5, 7, np.uint8), strict=True)
    for array in (loaded["slice"], loaded["repeated"], loaded["parameter"]):
        assert type(array) is np.ndarray
        array[0] = 1


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("kind", ["float64", "float32", "float16", "int64", "int32", "int16", "int8", "uint8", "bool"])
def test_all_number_types_and_protocols_equal_torch(kind, protocol):
    tensor = torch.tensor([[0, 1, 2], [3, 4, 5]]).to(getattr(torch, kind))
    loaded = load_torch_pickle(pickle.dumps([tensor], protocol), "x.pkl")
    np.testing.assert_array_equal(loaded[0], tensor.numpy(), strict=True)


def test_the_fast_parser_of_small_storages_equals_torch(monkeypatch):
    """One byte changed in a storage's own bytes: known no more, and read or refused by torch's rules as ever."""
    data = pickle.dumps([torch.randn(2, 3), torch.randn(300, dtype=torch.float64), torch.zeros(0)])
    blobs = [blob for blob, _ in _blobs(data)]
    assert all(torch_pickle._parse_common_storage(blob) is not None for blob in blobs)
    quick = load_torch_pickle(data, "x.pkl")
    for offset in range(len(blobs[0]) - 24):
        changed = bytearray(blobs[0])
        changed[offset] ^= 1
        elements = torch_pickle._parse_common_storage(bytes(changed))
        assert elements is None or elements.tobytes() == blobs[0][-24:]
    for corrupted in (blobs[0] + b"\0", blobs[0][:-1]):
        assert torch_pickle._parse_common_storage(corrupted) is None
    monkeypatch.setattr(torch_pickle, "_parse_common_storage", lambda _: None)
    for one, other in zip(quick, load_torch_pickle(data, "x.pkl"), strict=True):
        np.testing.assert_array_equal(one, other, strict=True)


def test_a_pickle_of_tensors_may_hold_arrays_where_a_format_has_them():
    data = pickle.dumps({"pose": {7: np.eye(4)}, "hand": torch.ones(2)})
    np.testing.assert_array_equal(load_torch_pickle(data, "x.pkl", arrays=True)["pose"][7], np.eye(4))
    with pytest.raises(BadInput, match="not allowed"):
        load_torch_pickle(data, "x.pkl")


@pytest.mark.parametrize("module", [b"ctorch\n", b"ctorch.cuda\n"], ids=["torch", "torch.cuda up to 1.9"])
def test_tensors_saved_on_a_gpu_come_to_the_cpu(module):
    tensor = torch.arange(6.0).reshape(3, 2)
    data = cuda_tagged(pickle.dumps({"a": tensor}, 3))
    if module != b"ctorch\n":
        data = with_blob(data, lambda blob: blob.replace(b"ctorch\n", module))
    np.testing.assert_array_equal(load_torch_pickle(data, "x.pkl")["a"], tensor.numpy(), strict=True)


def with_blob(data: bytes, change) -> bytes:
    """The same pickle (protocol 3) with its first storage's bytes changed."""
    blob, at = next(_blobs(data))
    new = change(blob)
    return data[:at] + b"B" + len(new).to_bytes(4, "little") + new + data[at + 5 + len(blob) :]


def test_torch_is_imported_only_where_a_tensor_is_read():
    code = "import sys, hoidata.files; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def saved(value, zipped: bool) -> bytes:
    stream = io.BytesIO()
    torch.save(value, stream, _use_new_zipfile_serialization=zipped)
    return stream.getvalue()


@pytest.mark.parametrize("protocol", [0, 2, 3, 4, 5])
def test_a_command_beside_a_tensor_does_not_run(tmp_path, protocol):
    trace = tmp_path / "trace"
    data = pickle.dumps({"a": torch.ones(2), "b": Call(os.system, f"touch {trace}")}, protocol)
    with pytest.raises(BadInput, match="not allowed"):
        load_torch_pickle(data, "x.pkl")
    assert not trace.exists()


@pytest.mark.parametrize("zipped", [False, True])
def test_a_command_inside_a_storage_does_not_run(tmp_path, zipped):
    trace = tmp_path / "trace"
    inner = saved(Call(os.system, f"touch {trace}"), zipped)
    data = pickle.dumps({"a": Call(torch.storage._load_from_bytes, inner)})
    with pytest.raises(BadInput, match=r"x\.pkl: expected"):
        load_torch_pickle(data, "x.pkl")
    assert not trace.exists()


@pytest.mark.parametrize("part", range(5))
def test_a_command_in_any_of_a_storages_five_pickles_does_not_run(tmp_path, part):
    trace = tmp_path / "trace"
    command = pickle.dumps(Call(os.system, f"touch {trace}"), 2)
    stream = io.BytesIO(saved(torch.ones(2).untyped_storage(), False))
    pieces = []
    for _ in range(5):
        start = stream.tell()
        _skip_pickle(stream)
        pieces.append(stream.getvalue()[start : stream.tell()])
    pieces[part] = command
    data = pickle.dumps(Call(torch.storage._load_from_bytes, b"".join(pieces) + stream.read()))
    with pytest.raises(BadInput, match=r"x\.pkl: expected"):
        load_torch_pickle(data, "x.pkl")
    assert not trace.exists()


def _skip_pickle(stream):
    for _ in pickletools.genops(stream):
        pass


def rebuilt(*arguments) -> bytes:
    return pickle.dumps(Call(torch._utils._rebuild_tensor_v2, *arguments))


STORAGE = torch.arange(4.0)._typed_storage()


@pytest.mark.parametrize(
    "data",
    [
        rebuilt(STORAGE, 0, (5,), (1,), False, OrderedDict()),
        rebuilt(STORAGE, 4, (1,), (1,), False, OrderedDict()),
        rebuilt(STORAGE, -1, (1,), (1,), False, OrderedDict()),
        rebuilt(STORAGE, 3, (4,), (-1,), False, OrderedDict()),
        rebuilt(STORAGE, 0, (2, 2), (1,), False, OrderedDict()),
        rebuilt(STORAGE, 0, (10**9,), (0,), False, OrderedDict()),
        rebuilt(STORAGE, 0, (10**6, 10**6, 10**6), (0, 0, 0), False, OrderedDict()),
        rebuilt(STORAGE, 0, (2**62, 0), (0, 1), False, OrderedDict()),
        rebuilt(STORAGE, 0, (1,) * 9, (1,) * 9, False, OrderedDict()),
        rebuilt(STORAGE, 0.0, (1,), (1,), False, OrderedDict()),
        rebuilt(STORAGE, 0, (1,), (1,), False, {1: "a hook"}),
        rebuilt([1.0], 0, (1,), (1,), False, OrderedDict()),
        pickle.dumps([rebuilt, 1]),
        pickle.dumps(STORAGE),
        pickle.dumps(torch.ones(2, dtype=torch.bfloat16)),
        pickle.dumps(torch.ones(2).to_sparse()),
        pickle.dumps(np.ones(2)),
        pickle.dumps(Call(OrderedDict, {"a": 1})),
        saved({"a": torch.ones(2)}, True),
        b"",
        b"no pickle",
    ],
)
def test_tensors_outside_their_storage_and_other_content_are_refused(data):
    with pytest.raises(BadInput, match=r"x\.pkl: expected"):
        load_torch_pickle(data, "x.pkl")


def test_many_repeated_tensors_together_cannot_fill_the_memory():
    one = torch.ones(1).expand(15 * 2**20)
    assert load_torch_pickle(pickle.dumps([one]), "x.pkl")[0].shape == (15 * 2**20,)
    with pytest.raises(BadInput, match="together far larger than the file"):
        load_torch_pickle(pickle.dumps([one.expand(15 * 2**20), one[:-1]]), "x.pkl")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"\x04\x00\x00\x00\x00\x00\x00\x00", b"\x05\x00\x00\x00\x00\x00\x00\x00"),
        (b"K\x04Nt", b"K\x05Nt"),
        (b"FloatStorage", b"QInt8Storage"),
        (b"M\xe9\x03.", b"M\xea\x03."),
        (b"Q.", b"0N."),
        (b"ctorch\n", b"cnumpy\n"),
    ],
    ids=["count", "length", "quantised", "protocol", "no storage", "other class"],
)
def test_a_storage_that_contradicts_itself_is_refused(old, new):
    data = pickle.dumps(torch.arange(4.0), 3)
    assert next(_blobs(data))[0].count(old) >= 1
    with pytest.raises(BadInput, match=r"x\.pkl: expected"):
        load_torch_pickle(with_blob(data, lambda blob: blob.replace(old, new)), "x.pkl")


def test_a_pickle_cannot_change_the_reader_of_the_next_file():
    change = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\nN}X\x0c\x00\x00\x00__defaults__K\x07\x85s\x86b."
    with pytest.raises(BadInput, match="not allowed"):
        load_torch_pickle(change, "x.pkl")


def test_a_missing_file_and_a_folder_are_bad_input(tmp_path):
    for path in (tmp_path / "none.pkl", tmp_path):
        with pytest.raises(BadInput, match="expected a pickle of tensors"):
            load_torch_pickle(path, path)


def test_truncated_files_raise_bad_input():
    data = pickle.dumps(hand_file())
    for length in range(0, len(data), 11):
        with pytest.raises(BadInput):
            load_torch_pickle(data[:length], "x.pkl")


def test_a_storage_named_many_times_cannot_fill_the_memory():
    """Each of 400 tensors would otherwise have a separate copy of 8 MB."""
    stream = io.BytesIO()
    storage = torch.zeros(2 * 2**20)._typed_storage()
    function, (blob,) = storage.__reduce__()
    calls = [Call(function, blob) for _ in range(400)]
    pickler = pickle.Pickler(stream, 4)
    pickler.dump([Call(torch._utils._rebuild_tensor_v2, call, 0, (1,), (1,), False, None) for call in calls])
    assert len(stream.getvalue()) < 9 * 2**20
    with pytest.raises(BadInput, match="together far larger than the file"):
        load_torch_pickle(stream.getvalue(), "x.pkl")
