"""Read torch's zip files of tensors (``torch.save`` since 1.6) without executing anything in them.

The members are looked at first: one pickle of known opcodes that names nothing but tensors, plain storages of the size
they claim, nothing compressed. Only then torch's own ``weights_only`` loading reads the file.
"""

import io
import pickle
import pickletools
import zipfile
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files.pickle_check import REFUSED_OPCODES, check_opcodes

MAX_FILE_BYTES = 4 << 30
_MAX_PICKLE_BYTES = 16 << 20
_MOST_MEMBERS = 20_000
# torch names a storage by a persistent id, whose class is the only other global.
_REFUSED = REFUSED_OPCODES - {"BINPERSID"} | {"STACK_GLOBAL", "NEWOBJ", "NEWOBJ_EX", "BUILD"}
_GLOBALS = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    *(f"torch {kind}Storage" for kind in ("Double", "Float", "Half", "BFloat16", "Long", "Int", "Bool")),
}
_REMEDY = "download it again from its own site; it is not opened otherwise, because it could run code"


def load_torch_zip(path: str | Path) -> Any:
    """The object in a zip file of ``torch.save``: tensors on the CPU in dicts, lists and tuples, numbers and strings.

    Raises BadInput for anything else: other globals, other members, files that are cut or over 4 GiB.
    """
    try:
        _check(Path(path))
        import torch

        return torch.load(path, map_location="cpu", weights_only=True)
    except BadInput:
        raise
    except Exception as error:  # a malformed file can raise anything
        text = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"[:300]
        raise BadInput(path, "a zip file of torch tensors", text, _REMEDY) from None


def _check(path: Path) -> None:
    if path.stat().st_size > MAX_FILE_BYTES:
        raise pickle.UnpicklingError(f"it has over {MAX_FILE_BYTES} bytes")
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > _MOST_MEMBERS or any(own.compress_type != zipfile.ZIP_STORED for own in members):
            raise pickle.UnpicklingError("members that torch does not write: too many, or compressed")
        if len({own.filename for own in members}) < len(members):
            raise pickle.UnpicklingError("two members of one name")
        pickles = [own for own in members if own.filename.endswith(".pkl")]
        if len(pickles) != 1 or not pickles[0].filename.endswith("/data.pkl"):
            raise pickle.UnpicklingError(f"{len(pickles)} pickles, expected data.pkl alone")
        if pickles[0].file_size > _MAX_PICKLE_BYTES:
            raise pickle.UnpicklingError(f"a pickle of {pickles[0].file_size} bytes")
        data = archive.read(pickles[0])
        if damaged := archive.testzip():
            raise pickle.UnpicklingError(f"{damaged} is damaged")
    check_opcodes(data, _REFUSED)
    for opcode, argument, _ in pickletools.genops(io.BytesIO(data)):
        if opcode.name == "GLOBAL" and argument not in _GLOBALS:
            raise pickle.UnpicklingError(f"it names {argument}")
