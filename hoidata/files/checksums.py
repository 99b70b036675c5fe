"""Checksums inside a safetensors file, which detect any changed bit.

``payload_sha256`` is the digest of the tensors; ``file_sha256`` that of the whole file with its 64 digits as zeros.
They detect accidents, not forgery, because anybody can compute them again.
"""

import json
import re
from pathlib import Path
from typing import Any, Literal

from hoidata.errors import BadInput
from hoidata.files.atomic import sha256_bytes

METADATA_KEY = "hoidata"
MAX_HEADER_BYTES = 100_000_000
MAX_CONTAINERS = 2_000_000  # a list takes sixty bytes of memory, and two in the file
BLANK = "0" * 64
# The entry of the metadata before ``sealed``.
EMPTY_CHECKSUMS = {"payload_sha256": BLANK, "file_sha256": BLANK}
# The metadata is JSON inside JSON, so its quotes are escaped.
_DIGEST = rb'(\\"%s\\":\\")([0-9a-f]{64})(?=\\")'
Fault = Literal["weights", "header"]


def sealed(data: bytes) -> bytes:
    """Fill in the checksums of a safetensors file whose metadata has ``EMPTY_CHECKSUMS``."""
    start = _payload_start(data)
    data = _with_digest(data, "payload_sha256", sha256_bytes(data[start:]))
    return _with_digest(data, "file_sha256", sha256_bytes(data))


def corrupted_part(path: str | Path) -> Fault | None:
    """The corrupted part of a checksummed file; None for an intact file and for one without checksums."""
    data = Path(path).read_bytes()
    seal = read_metadata(path).get("seal")
    if not isinstance(seal, dict):
        # A changed bit in the key "seal" leaves the digests in the header.
        return "header" if re.search(rb"(payload|file)_sha256", data[: _payload_start(data)]) else None
    if sha256_bytes(data[_payload_start(data) :]) != seal.get("payload_sha256"):
        return "weights"
    blank = _with_digest(data, "file_sha256", BLANK)
    return None if sha256_bytes(blank) == seal.get("file_sha256") else "header"


def verify_checksums(path: str | Path) -> None:
    """Raise BadInput for a file whose checksums do not match."""
    if fault := corrupted_part(path):
        expected = f"{fault} matching the checksum in the file"
        raise BadInput(path, expected, "others", "restore it with `dvc checkout`, or train it again")


def payload_digest(path: str | Path) -> str:
    """SHA-256 of a safetensors file's tensors, without the header."""
    data = Path(path).read_bytes()
    return sha256_bytes(data[_payload_start(data) :])


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Read the ``hoidata`` entry of a safetensors file's header without torch. Raises BadInput if it is missing."""
    with open(path, "rb") as stream:
        length = int.from_bytes(stream.read(8), "little")
        if not 2 <= length <= MAX_HEADER_BYTES:
            raise BadInput(path, "a safetensors file", f"a header of {length} bytes", "train it again")
        header = stream.read(length)
    if header.count(b"[") + header.count(b"{") > MAX_CONTAINERS:
        raise BadInput(path, f"a header of at most {MAX_CONTAINERS} lists", "more", "train it again")
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
    """Replace one digest in the header."""
    start = _payload_start(data)
    header = re.sub(_DIGEST % name.encode(), rb"\g<1>" + digest.encode(), data[:start])
    return header + data[start:]
