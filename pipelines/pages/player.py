"""Self-contained pages that play motions: three.js and the GLB are embedded in one HTML file.

three.js and its GLTFLoader (MIT) are in ``vendor``, with their version and licence. The camera starts where it sees the
whole motion, with hand and object next to each other.
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

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.files import write_whole
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints
from pipelines.pages import glb
from pipelines.pages.surface import ContactPaint

_FOLDER = Path(__file__).parent
_TEMPLATES = Environment(
    loader=FileSystemLoader(_FOLDER), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)
ASIDE_RAD = np.radians(40.0)  # a view past the touched side shows the border of the contact
_POINTS_FOR_VIEW = 400
_HAND_MARGIN_M = 0.015
_NEAR_M = 0.10


@dataclass(frozen=True)
class View:
    """The initial camera in the GLB's upright world (y up); without ground if ``ground_m`` is None."""

    centre: tuple[float, float, float]
    radius_m: float
    ground_m: float | None
    azimuth_rad: float
    elevation_rad: float
    frames: int
    fps: int = FPS


@dataclass(frozen=True)
class Player:
    """One motion on a page."""

    glb: bytes
    title: str  # for screen readers
    view: View
    caption: str = ""  # shown above the motion
    legend: tuple[tuple[str, str], ...] = ()  # (name, CSS colour)
    contact_label: str = ""  # meaning of the contact colours

    @property
    def view_values(self) -> dict:
        return asdict(self.view)

    @property
    def glb_packed(self) -> str:
        """The GLB as embedded in the page: deflated to a third of the bytes, then base64."""
        return base64.b64encode(zlib.compress(self.glb)).decode("ascii")


def motion_player(
    clip: Clip,
    hands: HandPair,
    title: str,
    caption: str = "",
    contact: ContactPaint | None = None,
    contact_label: str = "",
    ghosts: Mapping[Side, HandTrack] = MappingProxyType({}),
) -> Player:
    """A player of ``clip``: the valid hands and the object, coloured by ``contact`` with the meaning ``contact_label``.

    ``ghosts`` are transparent hands, those of the recording.
    """
    return Player(
        glb=glb.glb_bytes(clip, hands, contact, ghosts),
        title=title,
        view=view_of(clip, hands),
        caption=caption,
        legend=_legend(clip) + ((("as recorded", css_colour(glb.GHOST_COLOUR)),) if ghosts else ()),
        contact_label=contact_label if contact is not None else "",
    )


def contact_player(
    clip: Clip, paint: ContactPaint, title: str, caption: str, label: str, look_at: ContactPaint | None = None
) -> Player:
    """A player of the object in the pose of the first frame, coloured by ``paint``; ``label``: what the colours mean.

    The camera sees the touched side of the map ``look_at``, by default of ``paint``.
    """
    absent = {side: replace(track, valid=np.zeros_like(track.valid)) for side, track in clip.hands.items()}
    still = replace(clip, hands=absent, other_objects=()).take(slice(0, 1))
    view = _still_view(still, _touched_side(still, look_at or paint))
    return Player(glb=glb.glb_bytes(still, None, paint), title=title, view=view, caption=caption, contact_label=label)


def write_page(path: str | Path, template: str, **values: object) -> Path:
    """Write the HTML of one template of this package; values are escaped, and an undefined name is an error."""
    has_players = bool(values.get("has_players"))
    page = _TEMPLATES.get_template(template).render(
        css=Markup((_FOLDER / "page.css").read_text(encoding="utf-8")),
        three_js=Markup(three_javascript()) if has_players else "",
        player_js=Markup((_FOLDER / "player.js").read_text(encoding="utf-8")) if has_players else "",
        **values,
    )
    return write_whole(path, page)


@lru_cache(maxsize=1)
def three_javascript() -> str:
    """three.js and GLTFLoader, with the MIT notice at the top."""
    return "\n".join((_FOLDER / "vendor" / name).read_text("utf-8") for name in ("three.min.js", "GLTFLoader.min.js"))


def css_colour(colour: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(channel * 255):02x}" for channel in colour)


def _legend(clip: Clip) -> tuple[tuple[str, str], ...]:
    rows = [(f"{side} hand", css_colour(glb.HAND_COLOURS[side])) for side in SIDES if clip.hands[side].valid.any()]
    rows.append((clip.object_words, css_colour(glb.OBJECT_COLOUR)))
    if clip.object.is_articulated:
        rows.append(("moving part", css_colour(glb.MOVING_PART_COLOUR)))
    if others := dict.fromkeys(track.model.name.replace("_", " ") for track in clip.other_objects):
        rows.append((", ".join(others), css_colour(glb.OTHER_OBJECT_COLOUR)))
    return tuple(rows)


def view_of(clip: Clip, hands: HandPair) -> View:
    """A camera that sees the whole motion of the object and of nearby hands from the side.

    The ground is at the lowest point of all objects, tables included, and of all hands.
    """
    upright = glb.upright_rotation(clip.gravity).as_matrix()
    object_points = _object_points(clip.object) @ upright.T
    others = [_object_points(track) @ upright.T for track in clip.other_objects]
    tracks = [(track, hands[side]) for side, track in clip.hands.items() if track.valid.any()]
    valid_joints = [(track.valid, track_joints(track, model) @ upright.T) for track, model in tracks]
    hand_points = [joints[valid] for valid, joints in valid_joints if _comes_near(joints, valid, object_points)]
    shown = np.concatenate([object_points.reshape(-1, 3), *(points.reshape(-1, 3) for points in hand_points)])
    centre = (shown.min(axis=0) + shown.max(axis=0)) / 2
    radius = float(np.linalg.norm(shown - centre, axis=1).max()) + _HAND_MARGIN_M
    lowest_m = [points[..., 1].min() for points in (object_points, *others)]
    lowest = min(*lowest_m, *(joints[valid, :, 1].min() for valid, joints in valid_joints), np.inf)
    return View(
        centre=_rounded(centre),
        radius_m=round(radius, 4),
        ground_m=None if clip.gravity is None else round(float(lowest), 4),
        azimuth_rad=round(_side_azimuth(object_points, hand_points), 3),
        elevation_rad=0.42,
        frames=clip.n_frames,
    )


def _still_view(clip: Clip, look_from: np.ndarray) -> View:
    """A camera that sees the object of a one-frame clip from ``look_from`` (3,), at least a little from above."""
    points = _object_points(clip.object)[0] @ glb.upright_rotation(clip.gravity).as_matrix().T
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return View(
        centre=_rounded(centre),
        radius_m=round(float(np.linalg.norm(points - centre, axis=1).max()) * 1.2, 4),
        ground_m=None,
        azimuth_rad=round(float(np.arctan2(look_from[0], look_from[2]) + ASIDE_RAD), 3),
        elevation_rad=round(float(np.clip(np.arcsin(look_from[1]), 0.15, 1.0)), 3),
        frames=1,
    )


def _touched_side(clip: Clip, paint: ContactPaint) -> np.ndarray:
    """(3,) unit direction from the object's centre to its touched side, in the upright world of the first frame."""
    rotation = glb.upright_rotation(clip.gravity).as_matrix() @ rotvec_to_rotmat(clip.object.rotvec[:1])[0]
    toward = (paint.points_m - paint.points_m.mean(axis=0)).T @ paint.value
    direction = rotation @ toward + np.array((1e-6, 0.0, 1e-6))
    return direction / np.linalg.norm(direction)


def _object_points(track: ObjectTrack) -> np.ndarray:
    """(frame, point, 3) world points of an object, a regular subset of the vertices."""
    model = track.model
    step = max(1, len(model.vertices_m) // _POINTS_FOR_VIEW)
    return track.points_in_world(model.vertices_m[::step], model.part[::step])


def _comes_near(joints: np.ndarray, valid: np.ndarray, object_points: np.ndarray) -> bool:
    """Whether a joint comes within 10 cm of the object's bounding ball: an idle hand must not widen the view."""
    moving = np.broadcast_to(object_points, (len(joints), *object_points.shape[1:]))
    centre = moving.mean(axis=1, keepdims=True)
    reach = np.linalg.norm(moving - centre, axis=2).max(axis=1, keepdims=True)
    return bool(((np.linalg.norm(joints - centre, axis=2) - reach)[valid] < _NEAR_M).any())


def _side_azimuth(object_points: np.ndarray, hand_points: list[np.ndarray]) -> float:
    """Azimuth across the line from hands to object, so that neither occludes the other; pi/5 without hands."""
    if hand_points:
        wrists = np.concatenate([points[:, 0] for points in hand_points]).mean(axis=0)
        toward = object_points.reshape(-1, 3).mean(axis=0) - wrists
        if np.hypot(toward[0], toward[2]) >= 1e-3:
            return float(np.arctan2(toward[0], toward[2]) + np.radians(65.0))
    return float(np.pi / 5)


def _rounded(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 4) for value in vector)
    return x, y, z
