"""Errors with four parts: source, what was expected, what was found, and the remedy."""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NOT_ALLOWED = {errno.EROFS, errno.EACCES, errno.EPERM}


class HoidataError(Exception):
    """Base class of the errors for users; the text needs no traceback."""


class BadInput(HoidataError):
    """A file or value that cannot be used; conversion quarantines the sequence it belongs to.

    Args:
        where: the file, key or argument.
        expected: what would be valid.
        got: what was found.
        remedy: what the user can do.
    """

    def __init__(self, where: str | Path, expected: str, got: str, remedy: str = "download it again") -> None:
        self.where = str(where)
        self.expected = expected
        self.got = got
        self.remedy = remedy
        super().__init__(f"{where}: expected {expected}, got {got}; {remedy}")

    def __reduce__(self) -> tuple:
        return type(self), (self.where, self.expected, self.got, self.remedy)


class RawFileChanged(BadInput):
    """A raw file differs from the manifest because the raw folder changed during a run."""


class MachineError(HoidataError):
    """The machine failed, not the input: disk full or read-only, I/O error, too little memory."""


@contextmanager
def explain_machine_errors() -> Iterator[None]:
    """Raise MachineError with a remedy for a full or read-only disk, an I/O error, or too little memory."""
    try:
        yield
    except HoidataError:
        raise
    except Exception as error:
        if isinstance(error, BrokenPipeError) or not (message := _machine_message(error)):
            raise
        raise MachineError(message) from error


def _machine_message(error: Exception) -> str:
    """Message with a remedy; empty for an error that is more likely a defect of the program."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error}); end other programs or lower --jobs, and run again"
    rust_error = re.search(r"\(os error (\d+)\)", str(error))  # as libraries in Rust (safetensors) write it
    if type(error).__name__ == "OperationalError" and ("disk" in str(error) or "readonly" in str(error)):
        return f"DVC's database: {error}: no room, or it cannot be written; repair that and run again"
    if not isinstance(error, OSError) and not rust_error:
        return ""
    number = int(rust_error[1]) if rust_error else getattr(error, "errno", None)
    unchanged = "existing files are unchanged. Run again: finished work is resumed"
    # NumPy and Arrow report a short write without an error number.
    if number in _NO_SPACE or (number is None and "written" in str(error)) or "No space left" in str(error):
        return f"{error}: no space; make some room, {unchanged}"
    if number in _NOT_ALLOWED:
        return f"{error}: allow writing there; {unchanged}"
    return f"{error}: the disk fails; {unchanged}" if number == errno.EIO else ""


class MissingResource(HoidataError):
    """Something the user has to provide is missing: a licensed file, a path, an extra package."""
