"""What animated trajectories are written as: motion.npz (arrays), motion.glb and a page, the recording as a ghost."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, Clip, HandTrack, Side
from hoidata.files.arrays import write_npz
from hoidata.hands import HandPair
from pipelines.pages.glb import write_glb
from pipelines.pages.motion_files import ARRAYS as SHARED
from pipelines.pages.motion_files import drawn, motion_arrays
from pipelines.pages.player import motion_player, write_page

ARRAYS = SHARED | {"made": "(S, F) whether the fingers were made here"}
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
    arrays = motion_arrays(clip, hands) | {"made": made}
    write_npz(folder / "motion.npz", arrays)
    write_glb(folder / "motion.glb", clip, hands, ghosts=ghosts)
    write_page(
        folder / "index.html",
        "animation.html",
        title=clip.clip_id,
        synthetic=clip.synthetic,
        ghost=bool(ghosts),
        notes=list(notes),
        player=motion_player(drawn(clip), hands, clip.clip_id, ghosts=ghosts),
        facts=[*facts, ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s"), ("hand model", hands.name)],
        files=list(FILE_WORDS.items()),
        arrays=[(name, ARRAYS[name]) for name in arrays],
        has_players=True,
    )
    return [folder / name for name in (*FILE_WORDS, "index.html")]
