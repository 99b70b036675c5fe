"""Reference implementation of the sensors: brute force over triangles and rays, libigl's distances."""

import igl
import numpy as np


def inside(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(point,) bool: the surface subtends the whole sphere (solid angle)."""
    corner = vertices[faces][None] - points[:, None, None]
    a, b, c = corner[:, :, 0], corner[:, :, 1], corner[:, :, 2]
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    over = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
    under = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.abs(2 * np.arctan2(over, under).sum(axis=1)) > 2 * np.pi


def distances(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(point,) signed distance, and its gradient (point, 3), by libigl's nearest point and the solid angle."""
    square, _, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    sign = np.where(inside(vertices, faces, points), -1.0, 1.0)
    distance = sign * np.sqrt(square)
    return distance, (points - closest) / distance[:, None]


def ray(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray, direction: np.ndarray, reach: float) -> float:
    """Distance to the first triangle that faces the start (Moeller and Trumbore 1997); inf if none is hit."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    ab, ac = b - a, c - a
    across = np.cross(direction, ac)
    det = (ab * across).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((start - a) * across).sum(-1) / det
        q = np.cross(start - a, ab)
        v, t = (direction * q).sum(-1) / det, (ac * q).sum(-1) / det
    hit = (det > 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= reach)
    return float(t[hit].min()) if hit.any() else np.inf


def proximity(
    vertices: np.ndarray, faces: np.ndarray, start: np.ndarray, direction: np.ndarray, distance: float
) -> float:
    """Proximity as in ManipNet's release, metres. distance: signed distance of the sensor."""
    if distance >= 0.001:
        return min(ray(vertices, faces, start, direction, 0.1), 0.1)
    hit = ray(vertices, faces, start - 0.02 * direction, direction, 0.022)
    return hit - 0.02 if np.isfinite(hit) else (-0.02 if distance < 0 else 0.0)


def occupancy(vertices: np.ndarray, faces: np.ndarray, middle: np.ndarray, axes: np.ndarray, distance: float) -> float:
    """Occupancy of one cell of 1.8 cm: it is hit if clipping a triangle by its six planes leaves a polygon."""
    if distance <= 0:
        return 1.0
    if distance > 0.016:
        return 0.0
    corners = (vertices[faces] - middle) @ axes
    near = ((corners.min(axis=1) <= 0.009) & (corners.max(axis=1) >= -0.009)).all(axis=1)
    hit = distance <= 0.009 or any(_clipped(triangle) for triangle in corners[near])
    return 1 - distance / 0.018 if hit else 0.0


def _clipped(polygon: np.ndarray) -> bool:
    """Whether a triangle intersects the cube of half edge 9 mm about the origin (Sutherland and Hodgman 1974)."""
    for axis in range(3):
        for sign in (1, -1):
            clipped = []
            for first, second in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
                first_inside_m, second_inside_m = 0.009 - sign * first[axis], 0.009 - sign * second[axis]
                if first_inside_m >= 0:
                    clipped.append(first)
                if (first_inside_m > 0 > second_inside_m) or (first_inside_m < 0 < second_inside_m):
                    clipped.append(first + (second - first) * first_inside_m / (first_inside_m - second_inside_m))
            if not clipped:
                return False
            polygon = np.array(clipped)
    return True
