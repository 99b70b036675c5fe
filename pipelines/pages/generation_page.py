"""What a generated motion is written as: motion.npz (arrays), motion.glb (animated) and a page that plays it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair, track_joints, track_vertices
from hoidata.objects.sampling import SampledPoints
from hoidata.schema.clip import FPS, SIDES, Clip
from pipelines.pages.glb import write_glb
from pipelines.pages.player import motion_player, write_motion_page
from pipelines.pages.surface import ContactPaint


@dataclass(frozen=True)
class GeneratedMotion:
    """A motion made from a sentence.

    clip: the motion; a hand that takes no part is never valid. hands: the model its parameters belong to.
    text: the sentence. hand_type: "left", "right", "both"; hand_evidence: why. seed: what the noise was drawn from.
    points: the object's 1,024 points; contact: (2, point) predicted contact in [0, 1], sides ordered left, right.
    synthetic: the models behind it were trained on generated data. facts: further (name, value) rows for the page.
    answers_to: id of the recorded clip with the same sentence and object, where there is one.
    """

    clip: Clip
    hands: HandPair
    text: str
    hand_type: str
    hand_evidence: str
    seed: int
    points: SampledPoints | None = None
    contact: np.ndarray | None = None
    synthetic: bool = False
    facts: tuple[tuple[str, str], ...] = ()
    answers_to: str = ""


def write_generation(out_dir: str | Path, motion: GeneratedMotion, vertices: bool = False) -> list[Path]:
    """Write motion.npz, motion.glb and index.html; the same motion gives the same bytes. Gives the three paths.

    vertices: also store the hand meshes (about 19 KB per frame of both hands).
    """
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    paint = contact_paint(motion.points, motion.contact)
    write_npz(folder / "motion.npz", motion_arrays(motion, vertices))
    write_glb(folder / "motion.glb", motion.clip, motion.hands, paint)
    player = motion_player(motion.clip, motion.hands, motion.text, contact=paint, contact_label="predicted contact")
    write_motion_page(
        folder / "index.html",
        player,
        motion.text,
        _facts(motion),
        motion.synthetic,
        subtitle="Generated motion",
        files=[
            ("motion.npz", "joints, hand parameters, object pose and contact as plain arrays"),
            ("motion.glb", "the same motion as an animated model for any glTF 2.0 viewer"),
        ],
    )
    return [folder / name for name in ("motion.npz", "motion.glb", "index.html")]


def motion_arrays(motion: GeneratedMotion, vertices: bool = False) -> dict[str, np.ndarray]:
    """The arrays of motion.npz. Metres, radians, 30 fps, the clip's world frame; side axis: left, right.

    text (); fps (); gravity (3,) or (0,); valid (2, F) bool; joints_m (2, F, 21, 3); vertices_m (2, F, 778, 3) if asked
    wrist_m (2, F, 3), global_orient (2, F, 3), hand_pose (2, F, 45): axis-angle, absolute; betas (2, 1 or F, 10)
    object_rotvec (F, 3), object_translation_m (F, 3), object_hinge_rad (F,) if articulated
    object_vertices_m (V, 3), object_faces (N, 3), object_part (V,)
    contact_points_m (P, 3), contact_part (P,), contact (2, P) where predicted
    Rows of a hand where ``valid`` is False are zero.
    """
    clip = motion.clip
    tracks = [clip.hands[side] for side in SIDES]
    arrays = {
        "text": np.array(motion.text),
        "fps": np.array(FPS),
        "gravity": np.zeros(0) if clip.gravity is None else np.asarray(clip.gravity),
        "valid": np.stack([track.valid for track in tracks]),
    }
    joints = [track_joints(clip.hands[side], motion.hands[side]) for side in SIDES]
    arrays["joints_m"] = _where_valid(joints, arrays["valid"])
    if vertices:
        meshes = [track_vertices(clip.hands[side], motion.hands[side]) for side in SIDES]
        arrays["vertices_m"] = _where_valid(meshes, arrays["valid"])
    for name in ("wrist_m", "global_orient", "hand_pose"):
        arrays[name] = _where_valid([getattr(track, name) for track in tracks], arrays["valid"])
    arrays["betas"] = _betas(motion)
    return arrays | _object_arrays(motion)


def contact_paint(points: SampledPoints | None, contact: np.ndarray | None) -> ContactPaint | None:
    """Contact (2, point) or (point,) as paint: the stronger hand counts; None without points or contact."""
    if points is None or contact is None:
        return None
    value = np.asarray(contact, dtype=np.float64)
    return ContactPaint(points.points_m, points.part, value.max(axis=0) if value.ndim == 2 else value)


def _betas(motion: GeneratedMotion) -> np.ndarray:
    betas = [np.asarray(motion.clip.hands[side].betas) for side in SIDES]
    rows = max(len(values) for values in betas)
    return np.stack([np.broadcast_to(values, (rows, values.shape[1])) for values in betas]).astype(np.float32)


def _object_arrays(motion: GeneratedMotion) -> dict[str, np.ndarray]:
    track = motion.clip.object
    arrays = {
        "object_rotvec": track.rotvec.astype(np.float32),
        "object_translation_m": track.translation_m.astype(np.float32),
        "object_vertices_m": track.model.vertices_m.astype(np.float32),
        "object_faces": track.model.faces.astype(np.int32),
        "object_part": track.model.part.astype(np.uint8),
    }
    if track.hinge_rad is not None:
        arrays["object_hinge_rad"] = track.hinge_rad.astype(np.float32)
    if motion.points is not None and motion.contact is not None:
        arrays["contact_points_m"] = motion.points.points_m
        arrays["contact_part"] = motion.points.part
        arrays["contact"] = motion.contact.astype(np.float32)
    return arrays


def _where_valid(values: list[np.ndarray], valid: np.ndarray) -> np.ndarray:
    stacked = np.stack(values).astype(np.float32)
    return np.where(valid.reshape(*valid.shape, *[1] * (stacked.ndim - 2)), stacked, np.float32(0))


def _facts(motion: GeneratedMotion) -> list[tuple[str, str]]:
    clip = motion.clip
    data = "trained on SYNTHETIC data" if motion.synthetic else "trained on recorded data"
    return [
        ("hands", f"{motion.hand_type}: {motion.hand_evidence}"),
        ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s at {FPS} fps"),
        ("object", clip.object_words),
        ("seed", str(motion.seed)),
        ("models", data),
        ("hand model", motion.hands.name),
        *motion.facts,
    ]
