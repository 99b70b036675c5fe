"""Self-contained pages that play motions: three.js and the GLB inside the one HTML file, nothing fetched.

three.js (MIT) and its GLTFLoader are taken at run time from the viewer that the installed trimesh ships, so no copy of
them lives in this repository; a trimesh without that viewer is named as such.
"""

import base64
import re
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import trimesh.resources
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from hoidata.clips.clip import SIDES, Clip
from hoidata.errors import MissingResource
from hoidata.files import atomic_file
from hoidata.hands import HandPair
from pipelines.pages.glb import HAND_COLOURS, MOVING_PART_COLOUR, OBJECT_COLOUR, glb_bytes
from pipelines.pages.surface import ContactPaint
from pipelines.pages.view import View, still_view, view_of

_ROOM = Path(__file__).parent
_VIEWER = Path(trimesh.resources.__file__ or "").parent / "templates" / "viewer.zip"
_THREE = re.compile(r"<script>(/\*\*.*?THREE\.GLTFLoader=GLTFLoader;\}\)\(\);)", re.DOTALL)


@dataclass(frozen=True)
class Player:
    """One motion on a page. title: read aloud for the drawing; caption: shown above it; legend: (name, CSS colour)."""

    glb: bytes
    title: str
    view: View
    caption: str = ""
    legend: tuple[tuple[str, str], ...] = ()
    contact_label: str = ""

    @property
    def has_contact(self) -> bool:
        return bool(self.contact_label)

    @property
    def view_values(self) -> dict:
        return asdict(self.view)

    @property
    def glb_base64(self) -> str:
        return base64.b64encode(self.glb).decode("ascii")


def motion_player(
    clip: Clip,
    hands: HandPair,
    title: str,
    caption: str = "",
    contact: ContactPaint | None = None,
    contact_label: str = "within 2 cm of a joint",
) -> Player:
    """A player of ``clip``: the valid hands, the object, and ``contact`` painted on it."""
    return Player(
        glb=glb_bytes(clip, hands, contact),
        title=title,
        view=view_of(clip, hands),
        caption=caption,
        legend=_legend(clip),
        contact_label=contact_label if contact is not None else "",
    )


def contact_player(
    clip: Clip, paint: ContactPaint, title: str, caption: str, look_from: np.ndarray, label: str
) -> Player:
    """The clip's object at rest, as it lies in the first frame, with a contact map to turn and look at.

    look_from: (3,) where the camera starts, see ``touched_side``. label: what the colours mean.
    """
    absent = {side: replace(track, valid=np.zeros_like(track.valid)) for side, track in clip.hands.items()}
    still = replace(clip, hands=absent, other_objects=()).take(slice(0, 1))
    view = still_view(still, look_from)
    return Player(glb=glb_bytes(still, None, paint), title=title, view=view, caption=caption, contact_label=label)


def render_page(template: str, **values: object) -> str:
    """The finished HTML of one template of this room; autoescaped, and an unknown name is an error."""
    environment = Environment(
        loader=FileSystemLoader(_ROOM), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    has_players = bool(values.get("has_players"))
    return environment.get_template(template).render(
        css=Markup((_ROOM / "page.css").read_text(encoding="utf-8")),
        three_js=Markup(three_javascript()) if has_players else "",
        player_js=Markup((_ROOM / "player.js").read_text(encoding="utf-8")) if has_players else "",
        **values,
    )


def write_motion_page(
    path: str | Path,
    player: Player,
    title: str,
    facts: list[tuple[str, str]],
    synthetic: bool,
    subtitle: str = "",
    files: list[tuple[str, str]] | None = None,
    figures: list[dict[str, str]] | None = None,
    arrays: list[tuple[str, str]] | None = None,
) -> Path:
    """Write one self-contained page that plays ``player``.

    facts, files, arrays: (name, text) rows. figures: dicts of ``title`` and ``svg`` (trusted markup).
    """
    page = render_page(
        "motion.html", title=title, subtitle=subtitle, synthetic=synthetic, player=player, facts=facts,
        files=files or [], arrays=arrays or [], figures=trusted_figures(figures or []), has_players=True,
    )  # fmt: skip
    with atomic_file(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return Path(path)


def trusted_figures(figures: list[dict[str, str]]) -> list[dict[str, str]]:
    """Mark the drawings made by this room as finished markup, so that the template does not escape them."""
    return [{**figure, "svg": Markup(figure["svg"])} for figure in figures]


@lru_cache(maxsize=1)
def three_javascript() -> str:
    """three.js and GLTFLoader (minified, MIT notice included) from the installed trimesh.

    Raises MissingResource when that trimesh carries no such viewer.
    """
    remedy = f"install trimesh as pinned in constraints.txt (found {trimesh.__version__})"
    if not _VIEWER.is_file():
        raise MissingResource(f"{_VIEWER}: expected trimesh's bundled viewer, got no such file; {remedy}")
    with ZipFile(_VIEWER) as archive:
        page = archive.read("viewer.html.template").decode("utf-8")
    found = _THREE.search(page)
    if found is None:
        raise MissingResource(f"{_VIEWER}: expected three.js followed by GLTFLoader, got another layout; {remedy}")
    return found.group(1)


def css_colour(colour: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(channel * 255):02x}" for channel in colour)


def _legend(clip: Clip) -> tuple[tuple[str, str], ...]:
    rows = [(f"{side} hand", css_colour(HAND_COLOURS[side])) for side in SIDES if clip.hands[side].valid.any()]
    rows.append((clip.object_words, css_colour(OBJECT_COLOUR)))
    if clip.object.is_articulated:
        rows.append(("its moving part", css_colour(MOVING_PART_COLOUR)))
    return tuple(rows)
