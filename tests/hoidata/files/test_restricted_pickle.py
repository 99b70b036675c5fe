import io
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import hoidata.files
from hoidata.errors import BadInput
from hoidata.files import ARRAYS, restricted_load
from hoidata.files.array_pieces import _allowed
from hoidata.files.torch_pickle import STORAGE_NAMES, tensor_globals
from hoidata.hands.mano import _ALLOW


def sample():
    return {
        "c_order": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
        "big_endian": np.arange(3, dtype=">i4"),
        "words": np.array(["cup", "box"]),
        "flags": np.array([True, False]),
        "nested": [(np.ones(2), {"deep": np.zeros((0, 3))})],
        "objects": np.array([1, "x", np.arange(2)], dtype=object),
        "scalar": np.float32(2.5),
        "bytes": b"\xff\x00",
        "set": {1, 2},
        "text": "mug",
    }


def assert_same(got, expected):
    assert type(got) is type(expected)
    if isinstance(expected, dict):
        assert got.keys() == expected.keys()
        for key in expected:
            assert_same(got[key], expected[key])
    elif isinstance(expected, list | tuple) or (isinstance(expected, np.ndarray) and expected.dtype.hasobject):
        assert len(got) == len(expected)
        for one, other in zip(got, expected, strict=True):
            assert_same(one, other)
    elif isinstance(expected, np.ndarray):
        # NumPy turns big-endian arrays into native ones below protocol 5.
        assert got.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
        np.testing.assert_array_equal(got, expected)
    else:
        assert got == expected


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("core", [b"numpy.core", b"numpy._core"])
def test_arrays_in_containers_come_back_equal_under_both_numpy_spellings(protocol, core):
    if protocol >= 4:
        # Names carry their length from protocol 4 on, so only the writer's own spelling can be tested by replacement.
        data = pickle.dumps(sample(), protocol)
    else:
        data = pickle.dumps(sample(), protocol).replace(b"numpy._core", core)
        assert core + b".multiarray" in data
    assert_same(restricted_load(data, ARRAYS), sample())


def test_stream_and_bytes_give_the_same():
    data = pickle.dumps(sample())
    assert_same(restricted_load(io.BytesIO(data), ARRAYS), restricted_load(data, ARRAYS))


def test_arrays_are_plain_and_writable():
    array = restricted_load(pickle.dumps({"a": np.zeros(2)}), ARRAYS)["a"]
    array[0] = 1
    assert type(array) is np.ndarray


def test_shared_parts_are_read_once():
    shared = [np.zeros(1)]
    for _ in range(10):
        shared = [shared, shared]
    loaded = restricted_load(pickle.dumps({"shared": shared}), ARRAYS)
    assert loaded["shared"][0] is loaded["shared"][1]
    assert np.asarray(loaded["shared"]).shape == (*[2] * 10, 1, 1)


class Call:
    """Pickles as a call of ``function`` with ``arguments``."""

    def __init__(self, function, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


def nested_call(target):
    return {"a": [np.zeros(2), Call(os.system, f"touch {target}")]}


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_a_call_of_a_command_is_refused_and_does_not_run(tmp_path, protocol):
    trace = tmp_path / "trace"
    with pytest.raises(BadInput, match="not allowed"):
        restricted_load(pickle.dumps(nested_call(trace), protocol), ARRAYS)
    assert not trace.exists()


@pytest.mark.parametrize(
    "data",
    [
        b"cos\nsystem\n(S'true'\ntR.",
        b"(S'true'\nios\nsystem\n.",
        b"c__builtin__\neval\n(S'1'\ntR.",
        b"cnumpy\nload\n(S'x'\ntR.",
        b"cnumpy.core.multiarray\nfromfile\n.",
        b"\x80\x04\x8c\x08builtins\x8c\x04exec\x93.",
        b"\x80\x04\x8c\x0bnumpy._core\x8c\x21multiarray._reconstruct.__class__\x93.",
        b"P1\n.",
        b"\x80\x02\x82\x01.",
    ],
    ids=[
        "global",
        "inst",
        "eval",
        "numpy.load",
        "other numpy",
        "stack global",
        "dotted name",
        "persistent",
        "extension",
    ],
)
def test_names_outside_the_list_and_strange_opcodes_are_refused(data):
    with pytest.raises(BadInput, match="not allowed"):
        restricted_load(data, ARRAYS)


RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
DTYPE = b"cnumpy\ndtype\n"


@pytest.mark.parametrize(
    "data",
    [
        RECONSTRUCT + b"(cnumpy\ndtype\n(I0\ntS'b'\ntR.",
        RECONSTRUCT + b"(cnumpy\nndarray\n(I99999999999\ntS'b'\ntR.",
        b"cnumpy\nndarray\n((I99999999999\nttR.",
        DTYPE + b"(S'V8'\nI0\nI1\ntR.",
        DTYPE + b"(S'f8,O'\nI0\nI1\ntR.",
        DTYPE + b"(S'f8'\nI0\nI1\ntR(I3\nS'<'\nN(S'a'\ntN}I-1\nI-1\nI0\ntb.",
        b"c_codecs\nencode\n(Vabc\nVrot13\ntR.",
        b"c__builtin__\nset\n(I5\ntR.",
        b"\x80\x02N" + b"r\xff\xff\xff\x7f" + b".",
        RECONSTRUCT + b"(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I9\nt" + DTYPE + b"(S'f8'\nI0\nI1\ntRI00\nS'short'\ntb.",
    ],
    ids=["subtype", "shape", "array call", "void", "record", "fields", "rot13", "set of int", "memo", "short data"],
)
def test_allowed_names_refuse_harmful_arguments(data):
    with pytest.raises(BadInput):
        restricted_load(data, ARRAYS, encoding="latin1")


@pytest.mark.parametrize("shape", [b"M\x00\x40\x85", b"K\x02\x85", b"K\x03K\x03\x86"], ids=["many", "few", "square"])
def test_an_object_array_that_claims_another_number_of_items_is_refused(shape):
    """NumPy itself reads past the end of the list: such a file used to kill the process."""
    data = pickle.dumps(np.array([1, "x", None], dtype=object), 3)
    assert data.count(b"K\x03\x85") == 1
    with pytest.raises(BadInput, match="in the place of"):
        restricted_load(data.replace(b"K\x03\x85", shape), ARRAYS)


@pytest.mark.parametrize(
    "name", [b"builtins\nset", b"_codecs\nencode", b"numpy\nndarray", b"numpy.core.multiarray\nscalar"]
)
@pytest.mark.parametrize("state", [b"N}X\x0c\x00\x00\x00__defaults__K\x07\x85s\x86", b"}X\x01\x00\x00\x00aK\x07s"])
def test_an_allowed_name_cannot_be_changed_for_the_files_that_follow(name, state):
    with pytest.raises(BadInput):
        restricted_load(b"\x80\x02c" + name + b"\n" + state + b"b.", ARRAYS)
    assert restricted_load(b"\x80\x02cbuiltins\nset\n)R.", ARRAYS) == set()


def test_truncated_files_raise_bad_input():
    data = pickle.dumps(sample(), 2)
    for length in range(0, len(data), 7):
        with pytest.raises(BadInput, match="some file"):
            restricted_load(data[:length], ARRAYS, path="some file")


def test_flipped_bytes_are_read_or_refused_without_other_errors():
    data = pickle.dumps({"a": np.arange(4.0), "b": "text"}, 2)
    generator = np.random.default_rng(0)
    for _ in range(500):
        spoilt = bytearray(data)
        spoilt[generator.integers(len(data))] = generator.integers(256)
        try:
            restricted_load(bytes(spoilt), ARRAYS)
        except BadInput:
            continue


def test_larger_than_the_cap_is_refused():
    with pytest.raises(BadInput, match="at most 100 bytes"):
        restricted_load(io.BytesIO(pickle.dumps(np.zeros(100))), ARRAYS, max_bytes=100)


DEEP = b"\x80\x02})" + b"\x85" * 3_000 + b"Ns."
DOUBLED = b"\x80\x02})q\x00" + b"".join(b"h\x00h\x00\x86q\x00" for _ in range(60)) + b"Ns."
IN_A_SET = b"\x80\x02cbuiltins\nset\n])" + b"\x85" * 3_000 + b"a\x85R."
AS_ITEMS = b"\x80\x04\x8f(" + b")" + b"\x85" * 3_000 + b"\x90."
DOUBLED_AT_ONCE = b"\x80\x02})" + b"2\x86" * 60 + b"Ns."


@pytest.mark.parametrize("data", [DEEP, DOUBLED, IN_A_SET, AS_ITEMS, DOUBLED_AT_ONCE], ids=range(5))
def test_keys_that_would_overflow_the_stack_or_take_for_ever_to_hash_are_refused(data):
    """500,000 nested tuples as a key ended the process; 60 tuples of two, each within the next, took 2^60 steps."""
    with pytest.raises(BadInput, match="not allowed"):
        restricted_load(data, ARRAYS)


def test_a_pickle_of_millions_of_opcodes_is_refused(monkeypatch):
    monkeypatch.setattr("hoidata.files.pickle_check._MAX_OPCODES", 100)
    assert restricted_load(pickle.dumps([1] * 40), ARRAYS) == [1] * 40
    with pytest.raises(BadInput, match="more than 100 opcodes"):
        restricted_load(pickle.dumps([1] * 100), ARRAYS)


TEXT = b"X\x00\x00\x10\x00" + b"x" * (1 << 20) + b"q\x000"
ENCODED = b"c_codecs\nencode\n(h\x00Vlatin1\ntR"
BIG_ENDIAN = b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'>'\nNNNI-1\nI-1\nI0\ntb"
SWAPPED = RECONSTRUCT + b"(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I131072\nt" + BIG_ENDIAN + b"I00\nh\x00tb"
BUFFER = b"cnumpy.core.numeric\n_frombuffer\n(h\x00" + DTYPE + b"(S'f8'\nI0\nI1\ntR(I131072\ntS'C'\ntR"


@pytest.mark.parametrize(
    ("once", "call"), [(TEXT, ENCODED), (TEXT, SWAPPED), (TEXT, BUFFER)], ids=["bytes", "arrays", "buffers"]
)
def test_one_long_text_made_into_values_again_and_again_is_refused(once, call):
    """A hundred bytes for each call, a megabyte for each result: a small file could fill any memory."""
    assert len(restricted_load(b"\x80\x02" + once + b"](" + call * 3 + b"e.", ARRAYS, encoding="latin1")) == 3
    with pytest.raises(BadInput, match="far larger than the file"):
        restricted_load(b"\x80\x02" + once + b"](" + call * 200 + b"e.", ARRAYS, encoding="latin1")


def test_a_huge_integer_is_refused():
    """Hashing one of a megabyte a million times takes minutes; no dataset has one."""
    with pytest.raises(BadInput, match="LONG4"):
        restricted_load(pickle.dumps(1 << 4000), ARRAYS)


@pytest.mark.parametrize("name", ["frozenset", "number beyond 64 bits", "int", "complex128"])
def test_keys_whose_hash_a_file_can_choose_are_refused_by_name(name):
    """Thousands of keys of one hash take quadratic time: each is compared with all before it."""
    large = pickle.dumps(2**64, 2)[2:-1]
    data = {
        "frozenset": b"\x80\x04}(K\x01\x91Ns.",
        "number beyond 64 bits": b"\x80\x02}" + large + b"Ns.",
        "int": b"\x80\x02cbuiltins\nset\n](" + large + b"e\x85R.",
        "complex128": pickle.dumps({np.complex128(1j): None}, 2),
    }
    with pytest.raises(BadInput, match=f"{name}( as a key)?, which is not allowed"):
        restricted_load(data[name], ARRAYS)


def test_keys_of_64_bits_and_larger_values_are_read():
    keys = {
        2**64 - 1: 2**70,
        -(2**63): -(2**70),
        1.5: None,
        "x": True,
        b"y": frozenset((1,)),
        np.int64(7): np.float32(1),
    }
    for protocol in (2, 4):
        content = {key: value for key, value in keys.items() if protocol == 4 or not isinstance(value, frozenset)}
        assert restricted_load(pickle.dumps(content, protocol), ARRAYS) == content


def test_text_of_impossible_characters_is_refused():
    """Python raises a SystemError when such text is turned into a string, long after the file was read."""
    data = pickle.dumps(np.array(["cup"]), 5)
    spoilt = data.replace(b"c\0\0\0u\0\0\0", b"c\0\x11\xffu\0\0\0")
    assert spoilt != data
    with pytest.raises(BadInput, match="impossible characters"):
        restricted_load(spoilt, ARRAYS)


@pytest.mark.parametrize("data", [b"cnumpy\nndarray\n.", b"]cbuiltins\nset\na.", b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR."])
def test_results_contain_no_stand_ins_of_the_reader(data):
    with pytest.raises(BadInput, match="by itself"):
        restricted_load(data, ARRAYS)


# As in the specification of the raw formats, lists A and B, C and D.
ARRAY_NAMES = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy._core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
    ("__builtin__", "bytes"),
    ("__builtin__", "set"),
    ("builtins", "set"),
}
MANO_NAMES = {
    ("chumpy.ch", "Ch"),
    ("chumpy.reordering", "Select"),
    ("scipy.sparse.csc", "csc_matrix"),
    ("scipy.sparse._csc", "csc_matrix"),
}
TENSOR_NAMES = {
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
    ("torch.storage", "_load_from_bytes"),
    ("collections", "OrderedDict"),
}
STORAGES = {f"{kind}Storage" for kind in ("Double", "Float", "Half", "Long", "Int", "Short", "Char", "Byte", "Bool")}


def test_each_kind_of_file_has_exactly_the_specified_allow_list():
    assert set(ARRAYS) == ARRAY_NAMES
    assert set(_ALLOW) == ARRAY_NAMES | MANO_NAMES
    assert set(_allowed([])) == ARRAY_NAMES
    assert set(tensor_globals(1)) == TENSOR_NAMES
    assert set(STORAGE_NAMES) == {f"{module} {name}" for module in ("torch", "torch.cuda") for name in STORAGES}


def test_the_readme_lists_all_allowed_names():
    text = re.sub(r"\s+", " ", Path(hoidata.files.__file__).with_name("README.md").read_text())
    for module, name in ARRAY_NAMES | MANO_NAMES | TENSOR_NAMES:
        assert f"`{module} {name}`" in text or (f"`{module}`" in text and f"`{name}`" in text), (module, name)
    assert all(f"`{name}`" in text for name in STORAGES)


def test_allow_lists_contain_no_function_or_class_of_another_package():
    values = [*_ALLOW.values(), *tensor_globals(1).values()]
    for value in values:
        module = getattr(value, "__module__", None) or type(value).__module__
        assert module.startswith("hoidata.")
