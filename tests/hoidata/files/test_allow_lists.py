"""The exact names a pickle may hold, per kind of file, as the README of this room lists them."""

import re
from pathlib import Path

import hoidata.files
from hoidata.files import ARRAYS
from hoidata.files.array_pieces import _allowed
from hoidata.files.torch_pickle import STORAGE_NAMES, tensor_globals
from hoidata.hands.mano import _ALLOW

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


def test_each_kind_of_file_may_name_exactly_what_the_specification_lists():
    assert set(ARRAYS) == ARRAY_NAMES
    assert set(_ALLOW) == ARRAY_NAMES | MANO_NAMES
    assert set(_allowed([])) == ARRAY_NAMES
    assert set(tensor_globals(1)) == TENSOR_NAMES
    assert set(STORAGE_NAMES) == {f"{module} {name}" for module in ("torch", "torch.cuda") for name in STORAGES}


def test_the_readme_lists_every_name():
    text = re.sub(r"\s+", " ", Path(hoidata.files.__file__).with_name("README.md").read_text())
    for module, name in ARRAY_NAMES | MANO_NAMES | TENSOR_NAMES:
        assert f"`{module} {name}`" in text or (f"`{module}`" in text and f"`{name}`" in text), (module, name)
    assert all(f"`{name}`" in text for name in STORAGES)


def test_no_list_leads_to_a_real_function_or_class_of_another_package():
    values = [*_ALLOW.values(), *tensor_globals(1).values()]
    for value in values:
        module = getattr(value, "__module__", None) or type(value).__module__
        assert module.startswith("hoidata.")
