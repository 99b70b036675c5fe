"""A source sequence, or an interval of one, that was rejected, and the reason."""

from dataclasses import dataclass

from hoidata.errors import BadInput


@dataclass(frozen=True)
class Quarantined:
    """A rejected sequence or interval. All fields but the key are those of ``BadInput``."""

    source_key: str  # ``grab/s1/mug_drink_1``
    where: str
    expected: str
    got: str
    remedy: str

    @classmethod
    def from_error(cls, source_key: str, error: BadInput) -> "Quarantined":
        return cls(source_key, where=error.where, expected=error.expected, got=error.got, remedy=error.remedy)
