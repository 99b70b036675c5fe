"""What a made motion is written as: motion.npz (hands, object, mesh and hinge), motion.glb and a page that plays it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, Side
from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import thinned
from pipelines.pages.glb import write_glb
from pipelines.pages.player import write_page
from pipelines.pages.surface import ContactPaint

MOST_FACES_DRAWN = 30_000

# What the arrays mean. Axes: S = 2 sides (left, right), F frames.
ARRAYS = {
    "fps": "frames per second",
    "gravity": "(3,) direction things fall; empty where unknown",
    "valid": "(S, F) whether the hand takes part",
    "joints_m": "(S, F, 21, 3) MANO's 16 joints, then the tips of index, middle, pinky, ring, thumb",
    "wrist_m": "(S, F, 3) world position of the wrist joint",
    "global_orient": "(S, F, 3) axis-angle about the wrist joint",
    "hand_pose": "(S, F, 45) axis-angle of the 15 finger joints; zero is the flat hand",
    "betas": "(S, 1 or F, 10) hand shape, added to the rest mesh",
    "template_m": "(S, vertex, 3) the person's own rest meshes; empty where the hand model's is the rest mesh",
    "object_rotvec": "(F, 3) axis-angle of world from object",
    "object_translation_m": "(F, 3) world position of the object's origin",
    "object_hinge_rad": "(F,) hinge angle of an articulated object",
    "object_vertices_m": "(vertex, 3) mesh in the object's own frame",
    "object_faces": "(face, 3) vertex numbers",
    "object_part": "(vertex,) 1 where the hinge moves it",
    "object_hinge_axis": "(3,) direction of the hinge of an articulated object, in its own frame",
    "object_hinge_origin_m": "(3,) a point on the hinge",
}


@dataclass(frozen=True, eq=False)
class MotionFiles:
    """One motion: arrays of its .npz; clip, paint and ghosts of its .glb. checkpoints: digests of its networks."""

    clip: Clip
    arrays: Mapping[str, np.ndarray]
    paint: ContactPaint | None = None
    ghosts: Mapping[Side, HandTrack] = field(default_factory=dict)
    checkpoints: Mapping[str, str] | None = None
    number: int = 0


def write_motions(
    folder: Path,
    template: str,
    made: Sequence[MotionFiles],
    hands: HandPair,
    meanings: Mapping[str, str],
    painted: str = "",
    **page: object,
) -> list[Path]:
    """Write motion.npz, motion.glb (for further motions motion-1.npz, ...) and index.html; gives their paths.

    meanings: of all arrays. painted: what the colours of the .glb mean. page: values of the template. The same motions
    give the same bytes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for motion in made:
        name = f"motion-{motion.number}" if motion.number else "motion"
        extras = None if motion.checkpoints is None else {"checkpoints": dict(motion.checkpoints)}
        write_npz(folder / f"{name}.npz", motion.arrays)
        write_glb(folder / f"{name}.glb", motion.clip, hands, motion.paint, motion.ghosts, extras)
        paths += [folder / f"{name}.npz", folder / f"{name}.glb"]
    words = {
        ".glb": "; painted: ".join(filter(None, ("an animated model for any glTF 2.0 viewer", painted))),
        ".npz": "plain arrays, metres and radians: numpy.load('motion.npz')",
    }
    page |= {"files": [(path.name, words[path.suffix]) for path in paths], "synthetic": made[0].clip.synthetic}
    page |= {"arrays": [(name, meanings[name]) for name in made[0].arrays], "has_players": True}
    return [*paths, write_page(folder / "index.html", template, **page)]


def motion_arrays(clip: Clip, hands: HandPair) -> dict[str, np.ndarray]:
    """Of both hands and the object's motion: metres, radians, 30 fps, world frame.

    Rows of a hand where ``valid`` is False are zero.
    """
    tracks = [clip.hands[side] for side in SIDES]
    valid = np.stack([track.valid for track in tracks])
    values, (_, templates_m) = {"joints_m": clip_joints_m(clip, hands)}, hand_shapes(clip)
    for name in ("wrist_m", "global_orient", "hand_pose"):
        values[name] = _where_valid([getattr(track, name) for track in tracks], valid)
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
    """The object at rest, in its own frame."""
    arrays = {
        "object_vertices_m": model.vertices_m.astype(np.float32),
        "object_faces": model.faces.astype(np.int32),
        "object_part": model.part.astype(np.uint8),
    }
    if model.hinge is not None:
        arrays["object_hinge_axis"] = np.asarray(model.hinge.axis, np.float64)
        arrays["object_hinge_origin_m"] = np.asarray(model.hinge.origin_m, np.float64)
    return arrays


def clip_joints_m(clip: Clip, hands: HandPair) -> np.ndarray:
    """(2, frame, 21, 3) world joints of both hands, zero where they are not valid."""
    valid = np.stack([clip.hands[side].valid for side in SIDES])
    return _where_valid([track_joints(clip.hands[side], hands[side]) for side in SIDES], valid)


def drawn(clip: Clip, most_faces: int = MOST_FACES_DRAWN) -> Clip:
    """The clip for a page: large meshes are thinned, the files keep them whole."""
    return replace(clip, object=replace(clip.object, model=thinned(clip.object.model, most_faces)))


def hand_shapes(clip: Clip) -> tuple[np.ndarray, np.ndarray | None]:
    """(2, 10) mean betas and (2, 778, 3) personal rest meshes, metres, of both hands; None where one has no mesh."""
    tracks = [clip.hands[side] for side in SIDES]
    templates = [track.template_m for track in tracks if track.template_m is not None]
    betas = np.stack([track.mean_betas for track in tracks]).astype(np.float32)
    return betas, np.stack(templates).astype(np.float32) if len(templates) == len(SIDES) else None


def _where_valid(values: list[np.ndarray], valid: np.ndarray) -> np.ndarray:
    stacked = np.stack(values).astype(np.float32)
    return np.where(valid.reshape(*valid.shape, *[1] * (stacked.ndim - 2)), stacked, np.float32(0))
