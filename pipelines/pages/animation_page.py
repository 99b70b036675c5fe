"""What animated trajectories are written as: motion.npz (arrays), motion.glb and a page, the recording as a ghost."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, Side
from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair, track_joints
from hoidata.objects.user_mesh import thinned
from pipelines.pages.generation_page import ARRAYS as SHARED
from pipelines.pages.generation_page import MOST_FACES_DRAWN
from pipelines.pages.glb import write_glb
from pipelines.pages.player import motion_player, write_page

ARRAYS = {name: SHARED[name] for name in ("fps", "gravity", "valid", "joints_m", "wrist_m", "global_orient")} | {
    "hand_pose": SHARED["hand_pose"],
    "made": "(S, F) whether the fingers were made here",
    "betas": SHARED["betas"],
    "object_rotvec": SHARED["object_rotvec"],
    "object_translation_m": SHARED["object_translation_m"],
    "object_hinge_rad": SHARED["object_hinge_rad"],
}
FILE_WORDS = {
    "motion.npz": "plain arrays, metres and radians: numpy.load('motion.npz')",
    "motion.glb": "an animated model for any glTF 2.0 viewer",
}


def write_animation(
    out_dir: str | Path,
    clip: Clip,
    made: np.ndarray,
    ghosts: Mapping[Side, HandTrack],
    hands: HandPair,
    facts: Sequence[tuple[str, str]],
    notes: Sequence[str],
) -> list[Path]:
    """Write motion.npz, motion.glb and index.html; gives their paths. The same motion gives the same bytes.

    made: (2, frame) bool, where the clip's fingers were made. ghosts: the recorded hands behind them.
    """
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    drawn = replace(clip, object=replace(clip.object, model=thinned(clip.object.model, MOST_FACES_DRAWN)))
    arrays = animation_arrays(clip, made, hands)
    write_npz(folder / "motion.npz", arrays)
    write_glb(folder / "motion.glb", clip, hands, ghosts=ghosts)
    write_page(
        folder / "index.html",
        "animation.html",
        title=clip.clip_id,
        synthetic=clip.synthetic,
        ghost=bool(ghosts),
        notes=list(notes),
        player=motion_player(drawn, hands, clip.clip_id, ghosts=ghosts),
        facts=[*facts, ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s"), ("hand model", hands.name)],
        files=list(FILE_WORDS.items()),
        arrays=[(name, ARRAYS[name]) for name in arrays],
        has_players=True,
    )
    return [folder / name for name in (*FILE_WORDS, "index.html")]


def animation_arrays(clip: Clip, made: np.ndarray, hands: HandPair) -> dict[str, np.ndarray]:
    """The arrays of motion.npz, as ``ARRAYS`` explains them."""
    valid = np.stack([clip.hands[side].valid for side in SIDES])
    tracks = [clip.hands[side] for side in SIDES]
    values = {"joints_m": [track_joints(track, hands[side]) for track, side in zip(tracks, SIDES, strict=True)]}
    values |= {name: [getattr(track, name) for track in tracks] for name in ("wrist_m", "global_orient", "hand_pose")}
    arrays = {
        "fps": np.array(FPS),
        "gravity": np.zeros(0) if clip.gravity is None else np.asarray(clip.gravity),
        "valid": valid,
        "made": made,
        "betas": np.stack(np.broadcast_arrays(*(track.betas for track in tracks))).astype(np.float32),
        "object_rotvec": clip.object.rotvec.astype(np.float32),
        "object_translation_m": clip.object.translation_m.astype(np.float32),
    }
    for name, rows in values.items():
        stacked = np.stack(rows).astype(np.float32)
        arrays[name] = np.where(valid.reshape(*valid.shape, *[1] * (stacked.ndim - 2)), stacked, np.float32(0))
    if clip.object.hinge_rad is not None:
        arrays["object_hinge_rad"] = clip.object.hinge_rad.astype(np.float32)
    return arrays
