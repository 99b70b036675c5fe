"""Settings of the stage contact, and the settings of an existing output."""

from dataclasses import dataclass
from pathlib import Path

from hoidata.contact.proximity import CONTACT_THRESHOLD_M
from hoidata.errors import BadInput
from hoidata.files.written import NUMBER, read_json, require_output
from hoidata.objects.sampling import POINT_COUNT
from hoidata.settings import build_config


@dataclass(frozen=True)
class ContactSettings:
    """Settings of the stage contact."""

    points: int = POINT_COUNT  # number of points sampled on each object
    threshold_m: float = CONTACT_THRESHOLD_M  # a closer joint touches the point; larger distances are not stored

    def __post_init__(self) -> None:
        if self.points < 1:
            raise BadInput("contact.points", "at least 1 point", f"{self.points}", "correct it")
        check_threshold("contact.threshold_m", self.threshold_m)


def check_threshold(setting: str, threshold_m: float) -> None:
    """Raise BadInput unless the threshold is positive."""
    if not threshold_m > 0:
        raise BadInput(setting, "metres above 0", repr(threshold_m), f"give a length such as {CONTACT_THRESHOLD_M}")


def read_contact_settings(folder: str | Path) -> ContactSettings:
    """Read the settings of an output of the stage contact. Raises MissingResource without an output."""
    path = Path(folder) / "info.json"
    require_output(folder, "contact")
    info = read_json(path, {"points": int, "threshold_m": NUMBER})
    return build_config(ContactSettings, {name: info[name] for name in ("points", "threshold_m")}, str(path))
