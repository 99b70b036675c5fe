"""MANO files: fixtures in the byte layout of the released files (Python 2, chumpy, SciPy), written by opcode."""

import os
import pickle
import pickletools
import struct
import sys

import numpy as np
import pytest
from scipy.sparse import csc_matrix

from hoidata.errors import BadInput, MissingResource
from hoidata.hands import load_embedded_hands, load_mano_hands
from tests.builders.mano import write_mano_pickle

SEVEN_GLOBALS = {
    "numpy.core.multiarray _reconstruct",
    "numpy ndarray",
    "numpy dtype",
    "__builtin__ set",
    "chumpy.ch Ch",
    "chumpy.reordering Select",
    "scipy.sparse.csc csc_matrix",
}


def text(value):
    data = value.encode("latin1")
    return b"U" + bytes([len(data)]) + data if len(data) < 256 else b"T" + struct.pack("<i", len(data)) + data


def integer(value):
    return b"K" + bytes([value]) if 0 <= value < 256 else b"J" + struct.pack("<i", value)


def group(*items):
    return b"(" + b"".join(items) + b"t"


def mapping(items):
    return b"}(" + b"".join(text(key) + value for key, value in items.items()) + b"u"


def array(value):
    value = np.asarray(value, order="C")
    kind = value.dtype.newbyteorder("<")
    dtype = b"cnumpy\ndtype\n" + group(text(kind.str[1:]), integer(0), integer(1)) + b"R"
    dtype += group(integer(3), text("<"), b"N", b"N", b"N", integer(-1), integer(-1), integer(0)) + b"b"
    empty = b"cnumpy.core.multiarray\n_reconstruct\n" + group(b"cnumpy\nndarray\n", integer(0) + b"\x85", text("b"))
    data = value.astype(kind).tobytes()
    raw = b"T" + struct.pack("<i", len(data)) + data
    state = group(integer(1), group(*(integer(length) for length in value.shape)), dtype, b"\x89", raw)
    return empty + b"R" + state + b"b"


def instance(module, name, state):
    return f"c{module}\n{name}\n".encode() + b")\x81" + mapping(state) + b"b"


def chumpy_select(directions):
    """Shape directions as released: elements of a (778, 3, 20) chumpy array."""
    all_20 = np.concatenate((directions, np.full_like(directions, 7.0)), axis=2)
    ids = np.arange(all_20.size).reshape(all_20.shape)[..., :10].ravel()
    empty_set = b"c__builtin__\nset\n](" + text("x") + b"e\x85R"
    inner = instance("chumpy.ch", "Ch", {"x": array(all_20), "_dirty_vars": empty_set, "_itr": b"N"})
    shape = group(*(integer(length) for length in directions.shape))
    return instance(
        "chumpy.reordering",
        "Select",
        {"a": inner, "idxs": array(ids), "preferred_shape": shape, "_depends_on_deps": mapping({}), "_itr": b"N"},
    )


def sparse(matrix):
    columns = csc_matrix(matrix)
    shape = group(*(integer(length) for length in matrix.shape))
    state = {"_shape": shape, "maxprint": integer(50)}
    state |= {name: array(getattr(columns, name)) for name in ("data", "indices", "indptr")}
    return instance("scipy.sparse.csc", "csc_matrix", state)


def released_layout(model, **replaced):
    """The bytes of a file in the layout of the MANO project, with the numbers of ``model``."""
    parents = np.array([[2**32 - 1, *model.parents[1:]], range(16)], dtype=np.int64)
    content = {
        "hands_components": array(model.components),
        "f": array(model.faces.astype(np.uint32)),
        "J_regressor": sparse(model.joint_regressor),
        "kintree_table": array(parents),
        "J": array(model.joint_regressor @ model.template_m),
        "hands_coeffs": array(np.zeros((2, 45))),
        "weights": array(model.skin_weights),
        "posedirs": array(model.pose_directions),
        "hands_mean": array(model.mean_pose),
        "bs_style": text("lbs"),
        "v_template": array(model.template_m),
        "shapedirs": chumpy_select(model.shape_directions),
        "bs_type": text("lrotmin"),
    }
    return b"\x80\x02" + mapping(content | replaced) + b"."


@pytest.fixture
def released_folder(tmp_path):
    pair = load_embedded_hands()
    (tmp_path / "MANO_LEFT.pkl").write_bytes(released_layout(pair.left))
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(released_layout(pair.right))
    return tmp_path


def test_fixture_has_the_globals_and_string_opcodes_of_a_released_file(released_folder):
    opcodes = list(pickletools.genops((released_folder / "MANO_RIGHT.pkl").read_bytes()))
    assert {argument for opcode, argument, _ in opcodes if opcode.name == "GLOBAL"} == SEVEN_GLOBALS
    names = {opcode.name for opcode, _, _ in opcodes}
    assert {"SHORT_BINSTRING", "BINSTRING", "NEWOBJ", "BUILD"} <= names
    assert not any("UNICODE" in name or "BINBYTES" in name for name in names)


def test_released_layout_loads_without_chumpy(released_folder):
    before = set(sys.modules)
    pair = load_mano_hands(released_folder)
    assert not any(name.startswith(("chumpy", "scipy.sparse.csc")) for name in set(sys.modules) - before)
    assert pair.name == "mano"
    assert pair.digest == load_embedded_hands().digest  # all numbers are equal


def test_models_folder_is_found_below_the_unpacked_download(released_folder, tmp_path_factory):
    above = tmp_path_factory.mktemp("download")
    (above / "mano_v1_2").mkdir()
    (above / "mano_v1_2" / "models").symlink_to(released_folder)
    assert load_mano_hands(above).digest == load_mano_hands(released_folder).digest


def test_plain_file_round_trips(tmp_path):
    pair = load_embedded_hands()
    write_mano_pickle(pair.left, tmp_path / "MANO_LEFT.pkl")
    write_mano_pickle(pair.right, tmp_path / "MANO_RIGHT.pkl")
    assert load_mano_hands(tmp_path).digest == pair.digest


def test_a_missing_file_is_named_with_the_place_to_register(tmp_path):
    with pytest.raises(MissingResource, match=r"MANO_LEFT\.pkl.*mano\.is\.tue\.mpg\.de"):
        load_mano_hands(tmp_path)


class Malicious:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def test_file_that_would_run_a_command_is_refused_and_nothing_runs(released_folder):
    trace = released_folder / "trace"
    (released_folder / "MANO_LEFT.pkl").write_bytes(pickle.dumps({"v_template": Malicious(trace)}, protocol=2))
    with pytest.raises(BadInput, match="system"):
        load_mano_hands(released_folder)
    assert not trace.exists()


def test_command_hidden_in_a_whole_mano_file_is_refused_and_nothing_runs(released_folder):
    trace = released_folder / "trace"
    call = b"cposix\nsystem\n" + text(f"touch {trace}") + b"\x85R"
    model = load_embedded_hands().left
    (released_folder / "MANO_LEFT.pkl").write_bytes(released_layout(model, hands_coeffs=call))
    with pytest.raises(BadInput, match=r"posix\.system"):
        load_mano_hands(released_folder)
    assert not trace.exists()


@pytest.mark.parametrize(
    ("key", "corrupted", "field"),
    [
        ("weights", lambda model: array(model.skin_weights * 1.1), "skin_weights"),
        ("v_template", lambda model: array(model.template_m[:700]), "template_m"),
        ("v_template", lambda model: array(model.template_m * np.nan), "template_m"),
        ("J_regressor", lambda model: sparse(model.joint_regressor * 2), "joint_regressor"),
        ("shapedirs", lambda model: text("lbs"), "shapedirs"),
        ("shapedirs", lambda model: instance("chumpy.ch", "Ch", {"y": integer(1)}), "shapedirs"),
        ("kintree_table", lambda model: array(np.zeros((2, 16), dtype=np.int64)), "parents"),
        ("f", lambda model: array(model.faces + 1), "faces"),
    ],
)
def test_impossible_content_is_refused(released_folder, key, corrupted, field):
    model = load_embedded_hands().left
    (released_folder / "MANO_LEFT.pkl").write_bytes(released_layout(model, **{key: corrupted(model)}))
    with pytest.raises(BadInput, match=rf"MANO_LEFT\.pkl: {field}"):
        load_mano_hands(released_folder)


def test_sparse_matrix_with_indices_outside_is_refused(released_folder):
    model = load_embedded_hands().left
    matrix = csc_matrix(model.joint_regressor)
    state = {"_shape": group(integer(16), integer(778)), "data": array(matrix.data), "indptr": array(matrix.indptr)}
    bad = instance("scipy.sparse.csc", "csc_matrix", state | {"indices": array(matrix.indices + 900)})
    (released_folder / "MANO_LEFT.pkl").write_bytes(released_layout(model, J_regressor=bad))
    with pytest.raises(BadInput, match="outside the matrix"):
        load_mano_hands(released_folder)


def test_swapped_files_are_noticed(tmp_path):
    pair = load_embedded_hands()
    write_mano_pickle(pair.right, tmp_path / "MANO_LEFT.pkl")
    write_mano_pickle(pair.left, tmp_path / "MANO_RIGHT.pkl")
    with pytest.raises(BadInput, match="left hand"):
        load_mano_hands(tmp_path)


@pytest.mark.parametrize("length", [0, 1, 1000, 100_000])
def test_truncated_file_is_refused(released_folder, length):
    path = released_folder / "MANO_LEFT.pkl"
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(BadInput, match=r"MANO_LEFT\.pkl"):
        load_mano_hands(released_folder)
