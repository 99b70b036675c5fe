"""ManipNet's physical realism with the units of its released sources: the variant "as released".

Kept as it is so that figures can be set beside the paper's, and because its floor should be seen: gravity is ten times
too small for lengths in decimetres, so part of a motion passes with no contact at all. Facts: the released C# sources
as described in ``reference/manipnet-data.md``; the driver of the evaluation is not public.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.physics.capsules import CapsuleContacts
from hoidata.physics.scene import Scene
from hoidata.physics.standard_units import force_columns, wrench_residuals

UNITS_PER_METRE = 10.0
GRAVITY_PER_S = 9.8
MOST_STEPS = 100


@dataclass(frozen=True)
class AsReleased:
    """Lengths in dm; velocity a forward difference per second, acceleration its difference per frame, not divided by
    the frame time; gravity 9.8 times the frame time; mass 1, inertia of the mesh in dm^2 about its centre of mass;
    angular velocity in object axes used as if in the world's; friction edges (+-1, 1/mu, 0), (0, 1/mu, +-1), not
    normalised; at most 100 steps; a frame passes when the mean of the six squared residuals is below 0.01.

    reference: the point that moves and that torques are about. The sources say the object's origin; the paper's Eq. 9
    the centre of mass. They agree where a mesh is centred; the released meshes are not, by up to 10 cm.
    """

    friction: float = 0.35
    limit: float = 0.01
    tolerance_m: float = 0.0
    reference: Literal["centre of mass", "origin"] = "centre of mass"
    at_centre: ClassVar[bool] = True

    def residuals(self, scene: Scene, contacts: CapsuleContacts) -> np.ndarray:
        """(frame,) mean of the six squared residuals."""
        centre = scene.motion.centre_m if self.reference == "centre of mass" else scene.poses.translation_m
        edges = friction_edges(contacts.normal, self.friction)
        arms = (contacts.point_m - centre[contacts.frame]) * UNITS_PER_METRE
        columns, offsets = force_columns(contacts.frame, arms, edges, scene.n_frames)
        return np.square(wrench_residuals(columns, offsets, self.wrench(scene, centre), MOST_STEPS)).mean(axis=1)

    def wrench(self, scene: Scene, centre_m: np.ndarray) -> np.ndarray:
        """(frame, 6) change of momentum per frame, gravity taken off; last frames repeat the one before."""
        step_s = 1 / scene.fps
        velocity = _forward(centre_m * UNITS_PER_METRE) / step_s
        rotmats, inertia = scene.poses.rotmats, scene.motion.inertia_kg_m2 * UNITS_PER_METRE**2
        turned = Rotation.from_matrix(rotmats[:-1].transpose(0, 2, 1) @ rotmats[1:]).as_rotvec() / step_s
        spin = np.concatenate([turned, turned[-1:]])
        force = _forward(velocity) - GRAVITY_PER_S * step_s * scene.gravity
        momentum = np.einsum("fij,fj->fi", inertia, spin)
        torque = np.einsum("fij,fj->fi", inertia, _forward(spin)) + step_s * np.cross(spin, momentum)
        return np.concatenate([force, torque], axis=1)


def friction_edges(normals: np.ndarray, friction: float) -> np.ndarray:
    """(contact, 4, 3) edges (+-1, 1/mu, 0), (0, 1/mu, +-1); the second axis turned onto the inward normal."""
    inward = -normals
    along = inward[:, 1].clip(-1 + 1e-9)
    x, _, z = inward.T
    # The smallest turn that takes (0, 1, 0) to the inward normal, column by column.
    first = np.stack([1 - x * x / (1 + along), -x, -x * z / (1 + along)], axis=1)
    third = np.stack([-x * z / (1 + along), -z, 1 - z * z / (1 + along)], axis=1)
    push = inward / friction
    return np.stack([first + push, -first + push, third + push, -third + push], axis=1)


def _forward(values: np.ndarray) -> np.ndarray:
    change = np.diff(values, axis=0)
    return np.concatenate([change, change[-1:]])
