"""GLB: the animated scene of the pages, with the 21 joints of each hand as empty nodes.

The nodes are exact where glTF's skins are not: those leave out pose correctives, and shapes that change.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, Side
from pipelines.exports.motion import ExportedClip
from pipelines.pages.glb import glb_bytes


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <clip>.glb."""
    for item in clips:
        markers: dict[Side, np.ndarray] = {
            side: item.joints[side] for side in SIDES if item.clip.hands[side].valid.any()
        }
        scene = glb_bytes(item.clip, item.hands, extras=item.motion_facts, markers=markers)
        (folder / f"{item.file_name}.glb").write_bytes(scene)
