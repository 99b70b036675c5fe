"""Checks of a joint against the size of its mesh. They find joints that are written in another unit."""

import math
from collections.abc import Mapping

import numpy as np
from scipy.optimize import minimize_scalar

from hoidata.errors import BadInput
from hoidata.objects.model import Hinge

MAX_TURN_RAD = 4 * math.pi  # of the limits of a hinge
MAX_SLIDE_DIAGONALS = 10.0  # of the limits of a slide
_FAR = 1e6  # diagonals; beyond it the distance from the centre is precise enough


def check_limits(source: str, is_prismatic: bool, limits: tuple[float, float], diagonal: float) -> None:
    """Raise BadInput for limits that no joint of the mesh has.

    Args:
        source: the joint, for messages.
        limits: lowest and highest position, radians, or the mesh's unit if prismatic.
        diagonal: of the mesh's bounding box, the mesh's unit.
    """
    largest, got = max(map(abs, limits)), f"{limits[0]:g} and {limits[1]:g}"
    unlimited = 'if the joint has no stop, remove the element "limit"'
    if is_prismatic and largest > MAX_SLIDE_DIAGONALS * diagonal:
        expected = f"limits of at most {MAX_SLIDE_DIAGONALS * diagonal:.3g}, ten times the diagonal of the meshes"
        raise BadInput(source, expected, got, f"they look like another unit: write that of the meshes; {unlimited}")
    if not is_prismatic and largest > MAX_TURN_RAD:
        unlimited = "if the joint has no stop, make its type continuous"
        radians = " and ".join(f"{math.radians(limit):.4g}" for limit in limits)
        remedy = f"they look like degrees: write radians, {radians}; {unlimited}" if largest < 1e4 else unlimited
        raise BadInput(source, "limits of at most 4 pi rad, two turns", got, remedy)


def check_axis_is_near(vertices: np.ndarray, hinge: Hinge, unit: str, units_m: Mapping[str, float]) -> None:
    """Raise BadInput if the axis of a hinge is farther from the mesh than its diagonal. Suggests the unit that fits.

    Args:
        vertices: (vertex, 3), the file's unit.
        hinge: the joint in the same unit.
        unit: name of that unit.
        units_m: metres of each unit.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))

    def diagonals_away(factor: float) -> float:
        return _distance_to_box(factor * hinge.origin_m, hinge.axis, low, high) / diagonal

    if hinge.is_prismatic or diagonals_away(1.0) <= 1:
        return
    # A small factor fits any mesh at the origin, so the largest factor of those that fit well is likely.
    factors = {name: metres / units_m[unit] for name, metres in units_m.items() if name != unit}
    fitting = [name for name, factor in factors.items() if diagonals_away(factor) <= 1]
    likely = min(fitting, key=lambda name: (round(diagonals_away(factors[name]), 1), -factors[name]), default=None)
    remedy = f"write a point on the axis in the mesh's unit ({unit})"
    if likely:
        point = ",".join(f"{value:.4g}" for value in factors[likely] * hinge.origin_m)
        remedy = f"{remedy}; if it is in {likely}, write {point}"
    expected = f"an axis within {diagonal:.3g} {unit} of the mesh, the diagonal of its bounding box"
    raise BadInput("--hinge", expected, f"one {diagonals_away(1.0) * diagonal:.3g} {unit} away", remedy)


def _distance_to_box(point: np.ndarray, direction: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Distance of a line from the box between the corners ``low`` and ``high``; direction: (3,) unit vector."""
    offset = point - (low + high) / 2
    foot = offset - (offset @ direction) * direction  # relative to the box's centre, the nearest point of the line
    half = (high - low) / 2
    reach = float(np.linalg.norm(half))
    if np.abs(foot).max() > _FAR * reach:
        return float(np.abs(foot).max())

    def gap(along: float) -> float:
        on_line = foot + along * direction
        return float(np.linalg.norm(on_line - np.clip(on_line, -half, half)))

    # Distance to a convex set is convex along a line, so one search finds the minimum.
    minimum = minimize_scalar(gap, bounds=(-reach, reach), method="bounded", options={"xatol": 1e-6 * reach})
    return gap(float(minimum.x))
