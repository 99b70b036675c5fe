"""How the sensors measure: what ManipNet's paper says, what its release does, and ours (``OURS``).

The presets differ where paper and release do. Not taken over from the release are its approximations of the object:
convex pieces instead of the mesh (for cylinder, cube and cup they are the same), and distances blended from a grid.
"""

from dataclasses import dataclass, replace
from typing import Literal

CELLS = 10  # along each axis of the ambient sensor


@dataclass(frozen=True)
class SensorSettings:
    """Lengths in metres, times in seconds, canonical axes (x to the fingers, y to the thumb, z out of the back).

    times_s: when proximity and distance are measured, 0 (now) first; the present hand is carried by the wrist's future.
    cell_m: edge of an ambient cell. ambient_offset_m: middle of the cube from the middle finger's knuckle.
    ambient_turn: the cells turn with the middle finger's knuckle joint, or with the wrist.
    reach_m: how far rays and distances go. behind_m: how far behind a touching sensor its ray starts, which is how deep
    proximity can be. touching_m: a sensor nearer than this, or inside, counts as touching; None: only those inside.
    """

    times_s: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    cell_m: float = 0.018
    ambient_offset_m: tuple[float, float, float] = (0.04, 0.0, -0.09)
    ambient_turn: Literal["knuckle", "wrist"] = "knuckle"
    reach_m: float = 0.1
    behind_m: float = 0.02
    touching_m: float = 0.001


RELEASED = SensorSettings()
OURS = RELEASED
PAPER = replace(RELEASED, ambient_turn="wrist", behind_m=0.1, touching_m=0.0)
PRESETS = {"ours": OURS, "paper": PAPER, "released": RELEASED}
