"""Errors that name the place, what was expected, what came, and what to do."""

from pathlib import Path


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


class MissingResource(HoidataError):
    """Something the user has to provide (a licensed file, a path, an extra package) is not there."""
