"""Settings of the stage contact, and those an output was made with: whatever comes later reads them there."""

from dataclasses import dataclass
from pathlib import Path

from hoidata.contact.proximity import CONTACT_THRESHOLD_M
from hoidata.errors import BadInput
from hoidata.files.written import NUMBER, read_json, require_output
from hoidata.objects.sampling import POINT_COUNT
from hoidata.settings import build_config


@dataclass(frozen=True)
class ContactSettings:
    """points: sampled on every object. threshold_m: a joint closer to a point touches it; larger ones are not kept."""

    points: int = POINT_COUNT
    threshold_m: float = CONTACT_THRESHOLD_M

    def __post_init__(self) -> None:
        if self.points < 1:
            raise BadInput("contact.points", "at least 1 point", f"{self.points}", "correct it")
        check_threshold("contact.threshold_m", self.threshold_m)


def check_threshold(where: str, threshold_m: float) -> None:
    """Raise BadInput unless the threshold is a length."""
    if not threshold_m > 0:
        raise BadInput(where, "metres above 0", repr(threshold_m), f"give a length such as {CONTACT_THRESHOLD_M}")


def read_contact_settings(folder: str | Path) -> ContactSettings:
    """The settings an output of the stage contact was made with. Raises MissingResource where there is none."""
    path = Path(folder) / "info.json"
    require_output(folder, "contact")
    info = read_json(path, {"points": int, "threshold_m": NUMBER})
    return build_config(ContactSettings, {name: info[name] for name in ("points", "threshold_m")}, str(path))
