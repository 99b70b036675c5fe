"""Writes a motion as motion.npz (hands, object, mesh and hinge), motion.glb and a page that plays it."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, Side
from hoidata.files import write_whole
from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import thinned
from pipelines.pages.glb import glb_bytes
from pipelines.pages.player import write_page
from pipelines.pages.surface import ContactPaint

MOST_FACES_ON_PAGE = 30_000

# The meaning of the arrays. Axes: S = 2 sides (left, right), F frames.
ARRAYS = {
    "fps": "frames per second",
    "gravity": "(3,) direction of gravity; empty if unknown",
    "valid": "(S, F) whether the hand is active",
    "joints_m": "(S, F, 21, 3) MANO's 16 joints, then the tips of index, middle, pinky, ring, thumb",
    "wrist_m": "(S, F, 3) world position of the wrist joint",
    "global_orient": "(S, F, 3) axis-angle about the wrist joint",
    "hand_pose": "(S, F, 45) axis-angle of the 15 finger joints; zero is the flat hand",
    "betas": "(S, 1 or F, 10) hand shape, added to the rest mesh",
    "template_m": "(S, vertex, 3) personal rest meshes; empty if the rest mesh is that of the hand model",
    "object_rotvec": "(F, 3) axis-angle of world from object",
    "object_translation_m": "(F, 3) world position of the object's origin",
    "object_hinge_rad": "(F,) hinge angle of an articulated object; metres if its joint is prismatic",
    "object_vertices_m": "(vertex, 3) mesh in the object frame",
    "object_faces": "(face, 3) vertex numbers",
    "object_part": "(vertex,) 1 where the hinge moves it",
    "object_hinge_axis": "(3,) direction of the hinge of an articulated object, in the object frame",
    "object_hinge_origin_m": "(3,) a point on the hinge; missing if the joint is prismatic",
}
# Those of motions that networks generated. P: object points.
GENERATED_ARRAYS = ARRAYS | {
    "checkpoints": "JSON: SHA-256 of each network's file by its path; `hoidata lineage motion.npz` reads it",
    "seed": "the random seed of the motion",
    "contact_points_m": "(P, 3) points of the object, in its frame",
    "contact_part": "(P,) 1 where the hinge moves the point",
}


@dataclass(frozen=True, eq=False)
class MotionFiles:
    """The content of the files of one motion."""

    clip: Clip
    arrays: Mapping[str, np.ndarray]  # of the .npz
    paint: ContactPaint | None = None  # on the object in the .glb
    ghosts: Mapping[Side, HandTrack] = field(default_factory=dict)  # transparent hands in the .glb
    checkpoints: Mapping[str, str] | None = None  # digests of the networks
    number: int = 0  # of the sample


def write_motions(
    folder: Path,
    template: str,
    motion_files: Sequence[MotionFiles],
    hands: HandPair,
    meanings: Mapping[str, str],
    colour_meaning: str = "",
    **values: object,
) -> list[Path]:
    """Write motion.npz, motion.glb (further motions: motion-1.npz, ...) and index.html; returns their paths.

    The same motions give the same bytes. ``colour_meaning``: that of the colours in the .glb.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for motion in motion_files:
        name = f"motion-{motion.number}" if motion.number else "motion"
        extras = None if motion.checkpoints is None else {"checkpoints": dict(motion.checkpoints)}
        write_npz(folder / f"{name}.npz", motion.arrays)
        glb = glb_bytes(motion.clip, hands, motion.paint, motion.ghosts, extras)
        write_whole(folder / f"{name}.glb", glb)
        paths += [folder / f"{name}.npz", folder / f"{name}.glb"]
    words = {
        ".glb": "; coloured by ".join(filter(None, ("an animated model for any glTF 2.0 viewer", colour_meaning))),
        ".npz": "plain arrays, metres and radians: numpy.load('motion.npz')",
    }
    values |= {"files": [(path.name, words[path.suffix]) for path in paths], "has_players": True}
    values |= {"arrays": [(name, meanings[name]) for name in motion_files[0].arrays]}
    return [*paths, write_page(folder / "index.html", template, synthetic=motion_files[0].clip.synthetic, **values)]


def older_motion_notes(folder: Path, written: Sequence[Path]) -> list[str]:
    """A note that names the motions of an earlier run in a folder, which are none of the ``written`` files."""
    names = {path.name for path in folder.glob("motion*") if re.fullmatch(r"motion(-\d+)?\.(npz|glb)", path.name)}
    older = sorted(names - {path.name for path in written})
    return [f"{folder} also has motions of an earlier run, which stay: {', '.join(older)}"] if older else []


def motion_arrays(clip: Clip, hands: HandPair) -> dict[str, np.ndarray]:
    """Arrays of both hands and the object motion: metres, radians, 30 fps, world frame; zero where not ``valid``."""
    tracks = [clip.hands[side] for side in SIDES]
    valid = np.stack([track.valid for track in tracks])
    values, (_, templates_m) = {"joints_m": clip_joints_m(clip, hands)}, hand_shapes(clip)
    for name in ("wrist_m", "global_orient", "hand_pose"):
        values[name] = _zero_where_invalid([getattr(track, name) for track in tracks], valid)
    arrays = {
        "fps": np.array(FPS),
        "gravity": np.zeros(0) if clip.gravity is None else np.asarray(clip.gravity),
        "valid": valid,
        **values,
        "betas": np.stack(np.broadcast_arrays(*(track.betas for track in tracks))).astype(np.float32),
        "template_m": np.zeros(0, np.float32) if templates_m is None else templates_m,
        "object_rotvec": clip.object.rotvec.astype(np.float32),
        "object_translation_m": clip.object.translation_m.astype(np.float32),
    }
    if clip.object.hinge_rad is not None:
        arrays["object_hinge_rad"] = clip.object.hinge_rad.astype(np.float32)
    return arrays


def mesh_arrays(model: ObjectModel) -> dict[str, np.ndarray]:
    """Arrays of the object's mesh and hinge at rest, in the object frame."""
    arrays = {
        "object_vertices_m": model.vertices_m.astype(np.float32),
        "object_faces": model.faces.astype(np.int32),
        "object_part": model.part.astype(np.uint8),
    }
    if model.hinge is not None:
        arrays["object_hinge_axis"] = np.asarray(model.hinge.axis, np.float64)
        if not model.hinge.is_prismatic:
            arrays["object_hinge_origin_m"] = np.asarray(model.hinge.origin_m, np.float64)
    return arrays


def clip_joints_m(clip: Clip, hands: HandPair) -> np.ndarray:
    """(2, frame, 21, 3) world joints of both hands, zero in invalid frames."""
    valid = np.stack([clip.hands[side].valid for side in SIDES])
    return _zero_where_invalid([track_joints(clip.hands[side], hands[side]) for side in SIDES], valid)


def simplified_for_page(clip: Clip, most_faces: int = MOST_FACES_ON_PAGE) -> Clip:
    """The clip with a simplified object mesh, for pages; files keep the full mesh."""
    return replace(clip, object=replace(clip.object, model=thinned(clip.object.model, most_faces)))


def hand_shapes(clip: Clip) -> tuple[np.ndarray, np.ndarray | None]:
    """(2, 10) mean betas and (2, 778, 3) personal rest meshes of both hands, metres; None if one has no mesh."""
    tracks = [clip.hands[side] for side in SIDES]
    templates = [track.template_m for track in tracks if track.template_m is not None]
    betas = np.stack([track.mean_betas for track in tracks]).astype(np.float32)
    return betas, np.stack(templates).astype(np.float32) if len(templates) == len(SIDES) else None


def _zero_where_invalid(values: list[np.ndarray], valid: np.ndarray) -> np.ndarray:
    stacked = np.stack(values).astype(np.float32)
    return np.where(valid.reshape(*valid.shape, *[1] * (stacked.ndim - 2)), stacked, np.float32(0))
