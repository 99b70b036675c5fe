"""Errors that name the place, what was expected, what came, and what to do."""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NOT_ALLOWED = {errno.EROFS, errno.EACCES, errno.EPERM}


class HoidataError(Exception):
    """Base of every error hoidata raises on purpose; its text is meant for the user."""


class BadInput(HoidataError):
    """A file or value that cannot be used. Conversion turns it into one quarantined sequence.

    The message always has four parts: where, what was expected, what came, what to do.
    """

    def __init__(self, where: str | Path, expected: str, got: str, remedy: str = "download it again") -> None:
        self.where = str(where)
        self.expected = expected
        self.got = got
        self.remedy = remedy
        super().__init__(f"{where}: expected {expected}, got {got}; {remedy}")

    def __reduce__(self) -> tuple:
        return type(self), (self.where, self.expected, self.got, self.remedy)


class ChangedMeanwhile(BadInput):
    """A raw file is not, or no longer, as it was listed: the data moved under a run; no sequence is to blame."""


class MachineTrouble(HoidataError):
    """The machine failed, not what it was given: no room on the disk, nothing may be written, a disk that fails."""


@contextmanager
def told_in_words() -> Iterator[None]:
    """What the system says of a full or read-only disk, or of too little memory, raised as MachineTrouble."""
    try:
        yield
    except HoidataError:
        raise
    except Exception as error:
        if isinstance(error, BrokenPipeError) or not (words := _trouble(error)):
            raise
        raise MachineTrouble(words) from error


def _trouble(error: Exception) -> str:
    """The trouble and what to do, in words; empty where the error is more likely a defect."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error}); end other programs or lower --jobs, and run again"
    told = re.search(r"\(os error (\d+)\)", str(error))  # so libraries in Rust tell it (safetensors)
    if type(error).__name__ == "OperationalError" and ("disk" in str(error) or "readonly" in str(error)):
        return f"DVC's database: {error}: no room, or it cannot be written; mend that and run again"
    if not isinstance(error, OSError) and not told:
        return ""
    number = int(told[1]) if told else getattr(error, "errno", None)
    kept = "what was there before is as it was. Run again: finished work is taken up"
    # NumPy and Arrow tell of a write that came short without a number.
    if number in _NO_ROOM or (number is None and "written" in str(error)) or "No space left" in str(error):
        return f"{error}: no room; make some, {kept}"
    if number in _NOT_ALLOWED:
        return f"{error}: allow writing there; {kept}"
    return f"{error}: the disk fails; {kept}" if number == errno.EIO else ""


class MissingResource(HoidataError):
    """Something the user has to provide (a licensed file, a path, an extra package) is not there."""
