"""What a generated motion is written as: motion.npz (arrays), motion.glb (animated) and a page that plays it."""

from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, SIDES
from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair, track_joints
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages.glb import write_glb
from pipelines.pages.player import motion_player, write_motion_page
from pipelines.pages.surface import ContactPaint

# Every array of motion.npz. Axes: S = 2 sides (left, right), F frames, P object points.
ARRAYS = {
    "text": "the sentence",
    "fps": "frames per second",
    "seed": "what the motion was drawn from",
    "gravity": "(3,) direction things fall; empty where unknown",
    "valid": "(S, F) whether the hand takes part",
    "joints_m": "(S, F, 21, 3) MANO's 16 joints, then the tips of index, middle, pinky, ring, thumb",
    "coarse_joints_m": "(S, F, 21, 3) the same before refinement",
    "wrist_m": "(S, F, 3) world position of the wrist joint",
    "global_orient": "(S, F, 3) axis-angle about the wrist joint",
    "hand_pose": "(S, F, 45) axis-angle of the 15 finger joints; zero is the flat hand",
    "betas": "(S, 1 or F, 10) hand shape",
    "object_rotvec": "(F, 3) axis-angle of world from object",
    "object_translation_m": "(F, 3) world position of the object's origin",
    "object_hinge_rad": "(F,) hinge angle of an articulated object",
    "object_vertices_m": "(vertex, 3) mesh in the object's own frame",
    "object_faces": "(face, 3) vertex numbers",
    "object_part": "(vertex,) 1 where the hinge moves it",
    "contact_points_m": "(P, 3) points of the object, in its own frame",
    "contact_part": "(P,) 1 where the hinge moves the point",
    "contact": "(P,) the contact map the motion was made for",
}


def write_generation(out_dir: str | Path, motion: GeneratedMotion, hands: HandPair) -> list[Path]:
    """Write motion.npz, motion.glb and index.html; the same motion gives the same bytes. Gives the three paths.

    hands: the model the motion's parameters belong to.
    """
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    text = str(motion.evidence["text"])
    paint = generated_contact(motion)
    arrays = motion_arrays(motion, hands)
    write_npz(folder / "motion.npz", arrays)
    write_glb(folder / "motion.glb", motion.clip, hands, paint)
    write_motion_page(
        folder / "index.html",
        motion_player(motion.clip, hands, text, contact=paint, contact_label="contact it was made for"),
        text,
        [*generation_facts(motion), ("hand model", hands.name)],
        motion.clip.synthetic,
        subtitle="Generated motion",
        files=[
            ("motion.glb", "the same motion as an animated model for any glTF 2.0 viewer"),
            ("motion.npz", "plain arrays, metres and radians: numpy.load('motion.npz')"),
        ],
        arrays=[(name, ARRAYS[name]) for name in arrays],
    )
    return [folder / name for name in ("motion.npz", "motion.glb", "index.html")]


def generated_contact(motion: GeneratedMotion) -> ContactPaint:
    """The contact map the motion was made for, as paint."""
    return ContactPaint(motion.points.points_m, motion.points.part, np.asarray(motion.contact, dtype=np.float64))


def generation_facts(motion: GeneratedMotion) -> list[tuple[str, str]]:
    """Rows (name, value) on how the motion came about: hands and why, length, object, seed, training data."""
    evidence, clip = motion.evidence, motion.clip
    hand = evidence["hand"]
    kind = "SYNTHETIC" if evidence["synthetic"] else "recorded"
    clips = ", ".join(f"{count} {kind} {name} clips" for name, count in evidence["trained_on"].items())
    return [
        ("hands", f"{hand['hand']} (decided by {hand['source']}: {hand['evidence']})"),
        ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s at {FPS} fps"),
        ("object", clip.object_words),
        ("seed", str(evidence["seed"])),
        ("trained on", clips),
    ]


def motion_arrays(motion: GeneratedMotion, hands: HandPair) -> dict[str, np.ndarray]:
    """The arrays of motion.npz, as ``ARRAYS`` explains them.

    Metres, radians, 30 fps, the clip's world frame. Rows of a hand where ``valid`` is False are zero.
    """
    clip = motion.clip
    valid = np.stack([clip.hands[side].valid for side in SIDES])
    joints, coarse = (
        _where_valid([track_joints(shown.hands[side], hands[side]) for side in SIDES], valid)
        for shown in (clip, motion.coarse)
    )
    arrays = {
        "text": np.array(str(motion.evidence["text"])),
        "fps": np.array(FPS),
        "seed": np.array(motion.evidence["seed"]),
        "gravity": np.zeros(0) if clip.gravity is None else np.asarray(clip.gravity),
        "valid": valid,
        "joints_m": joints,
        "coarse_joints_m": coarse,
    }
    for name in ("wrist_m", "global_orient", "hand_pose"):
        arrays[name] = _where_valid([getattr(clip.hands[side], name) for side in SIDES], valid)
    betas = np.broadcast_arrays(*(clip.hands[side].betas for side in SIDES))
    return arrays | {"betas": np.stack(betas).astype(np.float32)} | _object_arrays(motion)


def _object_arrays(motion: GeneratedMotion) -> dict[str, np.ndarray]:
    track = motion.clip.object
    arrays = {
        "object_rotvec": track.rotvec.astype(np.float32),
        "object_translation_m": track.translation_m.astype(np.float32),
        "object_vertices_m": track.model.vertices_m.astype(np.float32),
        "object_faces": track.model.faces.astype(np.int32),
        "object_part": track.model.part.astype(np.uint8),
        "contact_points_m": motion.points.points_m,
        "contact_part": motion.points.part,
        "contact": np.asarray(motion.contact, dtype=bool),
    }
    if track.hinge_rad is not None:
        arrays["object_hinge_rad"] = track.hinge_rad.astype(np.float32)
    return arrays


def _where_valid(values: list[np.ndarray], valid: np.ndarray) -> np.ndarray:
    stacked = np.stack(values).astype(np.float32)
    return np.where(valid.reshape(*valid.shape, *[1] * (stacked.ndim - 2)), stacked, np.float32(0))
