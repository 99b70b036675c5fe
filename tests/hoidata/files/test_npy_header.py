import io

import numpy as np
import pytest

from hoidata.errors import BadInput
from hoidata.files import load_npy, load_npy_object
from hoidata.files.npy_header import read_npy_header


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
def test_what_numpy_saves_is_read_alike_and_can_be_changed(tmp_path, array, version):
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
