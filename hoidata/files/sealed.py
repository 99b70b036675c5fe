"""A safetensors file that carries its own digests, so that one changed bit anywhere in it is noticed.

``payload_sha256`` is of the tensors, ``file_sha256`` of the whole file with these 64 digits as zeros. They tell
accidents, not forgery: whoever changes the file on purpose can seal it again.
"""

import json
import re
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.files.atomic import sha256_bytes

METADATA_KEY = "hoidata"
MAX_HEADER_BYTES = 100_000_000
MOST_CONTAINERS = 2_000_000  # a list takes sixty bytes, and two in the file
BLANK = "0" * 64
# What to write into the metadata before ``sealed``.
OPEN_SEAL = {"payload_sha256": BLANK, "file_sha256": BLANK}
# JSON inside JSON: its quotes are escaped.
_DIGEST = rb'(\\"%s\\":\\")([0-9a-f]{64})(?=\\")'
Fault = Literal["weights", "header"]


def sealed(data: bytes) -> bytes:
    """The bytes of a safetensors file whose metadata hold ``OPEN_SEAL``, with the digests in place."""
    start = _payload_start(data)
    data = _with_digest(data, "payload_sha256", sha256_bytes(data[start:]))
    return _with_digest(data, "file_sha256", sha256_bytes(data))


def seal_fault(path: str | Path) -> Fault | None:
    """Which part of a sealed file is not as it was written; None for a whole one and for one written before seals."""
    data = Path(path).read_bytes()
    seal = read_metadata(path).get("seal")
    if not isinstance(seal, dict):
        # A bit of the seal's own name is protected too: its digests are still there.
        return "header" if re.search(rb"(payload|file)_sha256", data[: _payload_start(data)]) else None
    if sha256_bytes(data[_payload_start(data) :]) != seal.get("payload_sha256"):
        return "weights"
    blank = _with_digest(data, "file_sha256", BLANK)
    return None if sha256_bytes(blank) == seal.get("file_sha256") else "header"


def check_seal(path: str | Path) -> None:
    """Raise BadInput for a file that was changed since it was written."""
    if fault := seal_fault(path):
        expected = f"the {fault} it was written with, by the digest it carries"
        raise BadInput(path, expected, "others", "restore it with `dvc checkout`, or train it again")


def payload_digest(path: str | Path) -> str:
    """SHA-256 of a safetensors file's tensors: equal for equal weights, whatever the header says."""
    data = Path(path).read_bytes()
    return sha256_bytes(data[_payload_start(data) :])


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The ``hoidata`` entry of a safetensors file's header, read without torch. Raises BadInput when there is none."""
    with open(path, "rb") as stream:
        length = int.from_bytes(stream.read(8), "little")
        if not 2 <= length <= MAX_HEADER_BYTES:
            raise BadInput(path, "a safetensors file", f"a header of {length} bytes", "train it again")
        header = stream.read(length)
    if header.count(b"[") + header.count(b"{") > MOST_CONTAINERS:
        raise BadInput(path, f"a header of at most {MOST_CONTAINERS} lists", "more", "train it again")
    try:
        values = json.loads(json.loads(header)["__metadata__"][METADATA_KEY])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInput(path, "a checkpoint with hoidata's provenance", "none", "train it with `dvc repro`") from error
    if not isinstance(values, dict):
        raise BadInput(path, "a checkpoint with hoidata's provenance", "none", "train it with `dvc repro`")
    return values


def _payload_start(data: bytes) -> int:
    return 8 + int.from_bytes(data[:8], "little")


def _with_digest(data: bytes, name: str, digest: str) -> bytes:
    """The file with another value of one digest of its header's seal."""
    start = _payload_start(data)
    header = re.sub(_DIGEST % name.encode(), rb"\g<1>" + digest.encode(), data[:start])
    return header + data[start:]
