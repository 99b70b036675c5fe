"""A source sequence (or a interval of one) that did not become clips, and why."""

from dataclasses import dataclass

from hoidata.errors import BadInput


@dataclass(frozen=True)
class Quarantined:
    """What was left out. source_key: e.g. ``grab/s1/mug_drink_1``; the other four fields are those of ``BadInput``."""

    source_key: str
    where: str
    expected: str
    got: str
    remedy: str

    @classmethod
    def from_error(cls, source_key: str, error: BadInput) -> "Quarantined":
        return cls(source_key, error.where, error.expected, error.got, error.remedy)
