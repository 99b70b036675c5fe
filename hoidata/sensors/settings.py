"""How the sensors measure: what ManipNet's paper says, what its release does, and ours.

Not taken over from the release are its approximations of the object: convex pieces instead of the mesh (of cylinder,
cube and cup there is one), and distances and normals blended from a grid.
"""

from dataclasses import dataclass, replace
from typing import Literal

CELLS = 10  # along each axis of the ambient sensor


@dataclass(frozen=True)
class SensorSettings:
    """Lengths in metres, times in seconds, canonical axes (x to the fingers, y to the thumb, z out of the back).

    times_s: when proximity and distance are measured, 0 (now) first; the present hand is carried by the wrist's future.
    cell_m: edge of an ambient cell. ambient_offset_m: middle of the cube from the middle finger's knuckle, along the
    wrist's axes. ambient_turn: the cells turn with that knuckle's joint, or with the wrist.
    reach_m: how far rays and distances go; depth_m: how deep distances go (1 m: all the way).
    inside: a ray of a sensor inside the object starts behind it, and comes forward ("forward"), or looks "backward".
    behind_m: how far behind such a ray starts, or how far it looks back. touching_m: sensors this near count as inside,
    but as at 0 where their ray meets nothing.
    """

    times_s: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    cell_m: float = 0.018
    ambient_offset_m: tuple[float, float, float] = (0.04, 0.0, -0.09)
    ambient_turn: Literal["knuckle", "wrist"] = "knuckle"
    reach_m: float = 0.1
    depth_m: float = 1.0
    inside: Literal["forward", "backward"] = "forward"
    behind_m: float = 0.02
    touching_m: float = 0.001


OURS = SensorSettings()  # as the release defines them
PAPER = replace(OURS, ambient_turn="wrist", depth_m=0.1, inside="backward", behind_m=0.1, touching_m=0.0)
