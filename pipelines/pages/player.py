"""Self-contained pages that play motions: three.js and the GLB inside the one HTML file, nothing fetched.

three.js (MIT) and its GLTFLoader are taken at run time from the viewer that the installed trimesh ships, so no copy of
them lives in this repository; a trimesh without that viewer is named as such.
"""

import base64
import re
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import trimesh.resources
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from hoidata.errors import MissingResource
from hoidata.files import atomic_file
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import articulate, place
from hoidata.schema.clip import FPS, SIDES, Clip
from pipelines.pages.glb import HAND_COLOURS, MOVING_PART_COLOUR, OBJECT_COLOUR, glb_bytes, upright_rotation
from pipelines.pages.surface import ContactPaint

_ROOM = Path(__file__).parent
_VIEWER = Path(trimesh.resources.__file__ or "").parent / "templates" / "viewer.zip"
_THREE = re.compile(r"<script>(/\*\*.*?THREE\.GLTFLoader=GLTFLoader;\}\)\(\);)", re.DOTALL)
_POINTS_FOR_VIEW = 400
_HAND_MARGIN_M = 0.015


@dataclass(frozen=True)
class View:
    """Where the camera starts, in the GLB's upright world (y up), metres and radians; ground_m None: no ground."""

    centre: tuple[float, float, float]
    radius_m: float
    ground_m: float | None
    azimuth_rad: float
    elevation_rad: float
    frames: int
    fps: int = FPS


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
    contact_label: str = "contact over the whole clip",
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


def view_of(clip: Clip, hands: HandPair) -> View:
    """A camera that sees the whole motion, from the side and a little above, between hand and object."""
    upright = upright_rotation(clip.gravity).as_matrix()
    object_points = _object_points(clip) @ upright.T
    hand_points = [point @ upright.T for point in _hand_points(clip, hands)]
    everything = np.concatenate([object_points.reshape(-1, 3), *(points.reshape(-1, 3) for points in hand_points)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    centre = (low + high) / 2
    radius = float(np.linalg.norm(everything - centre, axis=1).max()) + _HAND_MARGIN_M
    return View(
        centre=_rounded(centre),
        radius_m=round(radius, 4),
        ground_m=None if clip.gravity is None else round(float(low[1]), 4),
        azimuth_rad=round(_side_azimuth(object_points, hand_points), 3),
        elevation_rad=0.42,
        frames=clip.n_frames,
    )


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
) -> Path:
    """Write one self-contained page that plays ``player``; figures: ``title`` and ``svg`` (trusted)."""
    page = render_page(
        "motion.html", title=title, subtitle=subtitle, synthetic=synthetic, player=player, facts=facts,
        files=files or [], figures=trusted_figures(figures or []), has_players=True,
    )  # fmt: skip
    with atomic_file(path) as part:
        part.write_text(page, encoding="utf-8")
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


def _object_points(clip: Clip) -> np.ndarray:
    """(frame, point, 3) world points of the object, thinned evenly."""
    model, track = clip.object.model, clip.object
    step = max(1, len(model.vertices_m) // _POINTS_FOR_VIEW)
    local = articulate(model.vertices_m[::step], model.part[::step], model.hinge, track.hinge_rad)
    return place(local, track.rotvec, track.translation_m)


def _hand_points(clip: Clip, hands: HandPair) -> list[np.ndarray]:
    return [track_joints(track, hands[side])[track.valid] for side, track in clip.hands.items() if track.valid.any()]


def _side_azimuth(object_points: np.ndarray, hand_points: list[np.ndarray]) -> float:
    """Azimuth across the line from the hands to the object, so that neither hides the other; pi/5 without hands."""
    if not hand_points:
        return float(np.pi / 5)
    wrists = np.concatenate([points[:, 0] for points in hand_points]).mean(axis=0)
    toward = object_points.reshape(-1, 3).mean(axis=0) - wrists
    if np.hypot(toward[0], toward[2]) < 1e-3:
        return float(np.pi / 5)
    return float(np.arctan2(toward[0], toward[2]) + np.radians(65.0))


def _rounded(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 4) for value in vector)
    return x, y, z
