"""Settings of the virtual sensors: the definitions of ManipNet's paper and those of its release.

The release also approximates the object: convex pieces instead of the mesh (one piece for cylinder, cube and cup),
distances and normals interpolated from a grid. Those approximations are not reproduced.
"""

from dataclasses import dataclass, replace
from typing import Literal

CELLS = 10  # along each axis of the ambient sensor


@dataclass(frozen=True)
class SensorSettings:
    """Sensor ranges and times; canonical axes: x to the fingers, y to the thumb, z out of the back of the hand."""

    # When proximity and distance are measured, now first. The finger pose of now moves with the future wrist.
    times_s: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    cell_m: float = 0.018  # edge of an ambient cell
    # Centre of the ambient cube relative to the middle finger's knuckle, canonical axes.
    ambient_offset_m: tuple[float, float, float] = (0.04, 0.0, -0.09)
    ambient_turn: Literal["knuckle", "wrist"] = "knuckle"  # which joint the cells rotate with
    reach_m: float = 0.1  # longest ray, largest distance
    depth_m: float = 1.0  # largest depth; 1 m does not limit it
    # A sensor inside the object casts its ray forward from a start behind the skin, or backward from the skin.
    inside: Literal["forward", "backward"] = "forward"
    behind_m: float = 0.02  # how far behind the skin a forward ray starts; the length of a backward ray
    # A sensor this close counts as inside. It reads 0 if its ray hits nothing.
    touching_m: float = 0.001


OURS = SensorSettings()  # the definitions of the release
PAPER = replace(OURS, ambient_turn="wrist", depth_m=0.1, inside="backward", behind_m=0.1, touching_m=0.0)
