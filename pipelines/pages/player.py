"""Self-contained pages that play motions: three.js and the GLB inside the one HTML file, nothing fetched.

three.js and its GLTFLoader (MIT) lie in ``vendor``, where their version and licence are stated.
"""

import base64
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.files import write_whole
from hoidata.hands import HandPair
from pipelines.pages.glb import GHOST_COLOUR, HAND_COLOURS, MOVING_PART_COLOUR, OBJECT_COLOUR, glb_bytes
from pipelines.pages.surface import ContactPaint
from pipelines.pages.view import View, still_view, view_of

_ROOM = Path(__file__).parent


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
    def view_values(self) -> dict:
        return asdict(self.view)

    @property
    def glb_packed(self) -> str:
        """The GLB as the page holds it: deflated, a third of the bytes, then base64."""
        return base64.b64encode(zlib.compress(self.glb, 9)).decode("ascii")


def motion_player(
    clip: Clip,
    hands: HandPair,
    title: str,
    caption: str = "",
    contact: ContactPaint | None = None,
    contact_label: str = "",
    ghosts: Mapping[Side, HandTrack] = MappingProxyType({}),
) -> Player:
    """A player of ``clip``: the valid hands, the object, and ``contact`` painted on it. contact_label: its meaning.

    ghosts: hands to see through, those of the recording.
    """
    return Player(
        glb=glb_bytes(clip, hands, contact, ghosts),
        title=title,
        view=view_of(clip, hands),
        caption=caption,
        legend=_legend(clip) + ((("as recorded", css_colour(GHOST_COLOUR)),) if ghosts else ()),
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


def write_page(path: str | Path, template: str, **values: object) -> Path:
    """Write the finished HTML of one template, whole or not at all; arguments as in ``render_page``."""
    return write_whole(path, render_page(template, **values))


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


@lru_cache(maxsize=1)
def three_javascript() -> str:
    """three.js and GLTFLoader, with the MIT notice at the top."""
    return "\n".join((_ROOM / "vendor" / name).read_text("utf-8") for name in ("three.min.js", "GLTFLoader.min.js"))


def css_colour(colour: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(channel * 255):02x}" for channel in colour)


def _legend(clip: Clip) -> tuple[tuple[str, str], ...]:
    rows = [(f"{side} hand", css_colour(HAND_COLOURS[side])) for side in SIDES if clip.hands[side].valid.any()]
    rows.append((clip.object_words, css_colour(OBJECT_COLOUR)))
    if clip.object.is_articulated:
        rows.append(("its moving part", css_colour(MOVING_PART_COLOUR)))
    return tuple(rows)
