"""Compiled loops of the refinement: derivatives of skinned vertices, distances with their gradients.

The unknowns of one hand in one frame are 51: wrist position 3, a small rotation of the hand about the wrist 3 (world
axes, applied from the left), axis-angles of the 15 finger joints 45. Everything is float64 on one thread.

Functions that call each other are in this file: numba caches compiled code per file and misses changes in another file.
"""

import numpy as np
from numba import njit

N_UNKNOWNS = 51
_PARENT = np.array((-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14))


@njit(cache=True)
def place_joints(local_rotmats, bone, rotation, position):  # pragma: no cover (compiled)
    """Set ``rotation (frame, 16, 3, 3)`` and ``position (frame, 16, 3)`` of the finger joints; the wrist's are given.

    local_rotmats: (frame, 15, 3, 3) relative to the parent. bone: (15, 3) from each joint's parent to it, at rest.
    """
    for f in range(len(local_rotmats)):
        for j in range(1, 16):
            p = _PARENT[j]
            for a in range(3):
                position[f, j, a] = position[f, p, a]
                for b in range(3):
                    position[f, j, a] += rotation[f, p, a, b] * bone[j - 1, b]
                for c in range(3):
                    total = 0.0
                    for b in range(3):
                        total += rotation[f, p, a, b] * local_rotmats[f, j - 1, b, c]
                    rotation[f, j, a, c] = total


@njit(cache=True)
def skin_vertices(weight, rest_joint, rotation, position, rest, out):  # pragma: no cover (compiled)
    """Linear blend skinning: set ``out (frame, vertex, 3)`` from vertices ``rest (frame, vertex, 3)`` at rest.

    weight: (vertex, 16). rest_joint: (16, 3). rotation, position: of the joints, (frame, 16, 3, 3) and (frame, 16, 3).
    """
    shift = np.empty((16, 3))
    for f in range(len(rest)):
        for j in range(16):
            for a in range(3):
                shift[j, a] = position[f, j, a]
                for b in range(3):
                    shift[j, a] -= rotation[f, j, a, b] * rest_joint[j, b]
        for v in range(len(weight)):
            x, y, z = rest[f, v, 0], rest[f, v, 1], rest[f, v, 2]
            to_x, to_y, to_z = 0.0, 0.0, 0.0
            for j in range(16):
                w = weight[v, j]
                if w != 0.0:
                    r = rotation[f, j]
                    to_x += w * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + shift[j, 0])
                    to_y += w * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + shift[j, 1])
                    to_z += w * (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + shift[j, 2])
            out[f, v, 0], out[f, v, 1], out[f, v, 2] = to_x, to_y, to_z


@njit(cache=True)
def vertex_derivatives(frame, vertex, skin, chain, out):  # pragma: no cover (compiled)
    """Set ``out (pair, 3, 51)`` to the derivatives of the vertices ``vertex (pair,)`` in the frames ``frame (pair,)``.

    skin: weights (vertex, 16), rest joints (16, 3), pose directions (vertex, 3, 135), whether a joint's pose corrective
    moves a vertex (vertex, 16). chain: the fields of ``skin.Chain``.
    """
    weight, rest_joint, pose_direction, has_corrective = skin
    rotation, position, axis, local, rest = chain
    moment, subtree_weight, blend = np.empty((16, 3)), np.empty(16), np.empty((3, 3))
    for pair in range(len(frame)):
        f, v = frame[pair], vertex[pair]
        _gather(weight[v], rest_joint, rotation[f], position[f], rest[f, v], moment, subtree_weight, blend)
        out[pair] = 0.0
        for a in range(3):
            out[pair, a, a] = 1.0
        for j in range(16):
            if subtree_weight[j] != 0.0:
                # A joint moves its subtree as a rigid body: the derivative is axis x (weighted lever).
                x = moment[j, 0] - subtree_weight[j] * position[f, j, 0]
                y = moment[j, 1] - subtree_weight[j] * position[f, j, 1]
                z = moment[j, 2] - subtree_weight[j] * position[f, j, 2]
                for c in range(3):
                    ax, ay, az = axis[f, j, 0, c], axis[f, j, 1, c], axis[f, j, 2, c]
                    out[pair, 0, 3 + 3 * j + c] = ay * z - az * y
                    out[pair, 1, 3 + 3 * j + c] = az * x - ax * z
                    out[pair, 2, 3 + 3 * j + c] = ax * y - ay * x
            if has_corrective[v, j]:
                _add_bend(pose_direction[v, :, 9 * j - 9 : 9 * j], local[f, j - 1], blend, 3 + 3 * j, out[pair])


@njit(cache=True)
def _gather(weight, rest_joint, rotation, position, rest, moment, subtree_weight, blend):  # pragma: no cover (compiled)
    """Set sums over joints for one vertex.

    subtree_weight: (16,) weight of each joint and its descendants. moment: (16, 3) the same sum of weight times the
    position each joint gives the vertex. blend: (3, 3) blended rotation.
    """
    moment[:], subtree_weight[:], blend[:] = 0.0, weight, 0.0
    for j in range(16):
        w = weight[j]
        if w == 0.0:
            continue
        for a in range(3):
            total = position[j, a]
            for b in range(3):
                total += rotation[j, a, b] * (rest[b] - rest_joint[j, b])
                blend[a, b] += w * rotation[j, a, b]
            moment[j, a] = w * total
    for j in range(15, 0, -1):
        subtree_weight[_PARENT[j]] += subtree_weight[j]
        moment[_PARENT[j]] += moment[j]


@njit(cache=True)
def _add_bend(direction, local, blend, column, out):  # pragma: no cover (compiled)
    """Add the derivative of one joint's pose corrective: direction (3, 9), local (9, 3), out (3, 51)."""
    for c in range(3):
        for a in range(3):
            rest_change = 0.0
            for e in range(9):
                rest_change += direction[a, e] * local[e, c]
            for b in range(3):
                out[b, column + c] += blend[b, a] * rest_change


@njit(cache=True)
def add_squares(frame, slope, derivative, weight, residual, matrix, vector):  # pragma: no cover (compiled)
    """Add weighted squares of residuals to the normal equations of their frames; weight and residual: (pair,).

    The derivative of a residual is ``slope (pair, 3) @ derivative (pair, 3, 51)``. matrix: (frame, 51, 51), lower
    triangle; vector: (frame, 51), minus half the gradient.
    """
    gradient = np.empty(N_UNKNOWNS)
    for pair in range(len(frame)):
        f = frame[pair]
        for i in range(N_UNKNOWNS):
            gradient[i] = 0.0
            for a in range(3):
                gradient[i] += slope[pair, a] * derivative[pair, a, i]
        for i in range(N_UNKNOWNS):
            if gradient[i] != 0.0:
                scaled = weight[pair] * gradient[i]
                vector[f, i] -= scaled * residual[pair]
                for j in range(i + 1):
                    matrix[f, i, j] += scaled * gradient[j]


@njit(cache=True)
def lower_signed(low_m, cell_m, value, rotation, offset, points_m, distance_m, slope):  # pragma: no cover (compiled)
    """Minimum of distances and the signed distances of a grid: update ``distance_m (frame, point)`` and ``slope``.

    value: (z, y, x) signed distances, node (0, 0, 0) at low_m (3,), cell_m apart, interpolated trilinearly. rotation,
    offset: part-from-world of each frame. points_m: (frame, point, 3) world. slope: (frame, point, 3) gradient, world.
    Outside of the grid the distance to the grid is added to the value at its boundary.
    """
    last_x, last_y, last_z = value.shape[2] - 1, value.shape[1] - 1, value.shape[0] - 1
    for f in range(points_m.shape[0]):
        r, shift = rotation[f], offset[f]
        for p in range(points_m.shape[1]):
            wx, wy, wz = points_m[f, p, 0], points_m[f, p, 1], points_m[f, p, 2]
            grid_u = (r[0, 0] * wx + r[0, 1] * wy + r[0, 2] * wz + shift[0] - low_m[0]) / cell_m
            grid_v = (r[1, 0] * wx + r[1, 1] * wy + r[1, 2] * wz + shift[1] - low_m[1]) / cell_m
            grid_w = (r[2, 0] * wx + r[2, 1] * wy + r[2, 2] * wz + shift[2] - low_m[2]) / cell_m
            u, v, w = min(max(grid_u, 0.0), last_x), min(max(grid_v, 0.0), last_y), min(max(grid_w, 0.0), last_z)
            out_u, out_v, out_w = grid_u - u, grid_v - v, grid_w - w  # from the grid's boundary, in cells
            outside = np.sqrt(out_u * out_u + out_v * out_v + out_w * out_w)
            i, j, k = min(int(u), last_x - 1), min(int(v), last_y - 1), min(int(w), last_z - 1)
            u, v, w = u - i, v - j, w - k
            a, b = value[k, j, i], value[k, j, i + 1]
            c, d = value[k, j + 1, i], value[k, j + 1, i + 1]
            e, g = value[k + 1, j, i], value[k + 1, j, i + 1]
            h, m = value[k + 1, j + 1, i], value[k + 1, j + 1, i + 1]
            below, above = a + u * (b - a), c + u * (d - c)
            below_up, above_up = e + u * (g - e), h + u * (m - h)
            near, near_up = below + v * (above - below), below_up + v * (above_up - below_up)
            signed_m = near + w * (near_up - near) + outside * cell_m
            if not signed_m < distance_m[f, p]:
                continue
            distance_m[f, p] = signed_m
            first, second = (b - a) + v * ((d - c) - (b - a)), (g - e) + v * ((m - h) - (g - e))
            su = (first + w * (second - first)) / cell_m if out_u == 0.0 else out_u / outside
            sv = ((above - below) + w * ((above_up - below_up) - (above - below))) / cell_m
            sv = sv if out_v == 0.0 else out_v / outside
            sw = (near_up - near) / cell_m if out_w == 0.0 else out_w / outside
            for axis in range(3):
                slope[f, p, axis] = r[0, axis] * su + r[1, axis] * sv + r[2, axis] * sw


@njit(cache=True)
def lower_capsules(start_m, end_m, radius_m, points_m, distance_m, slope):  # pragma: no cover (compiled)
    """Minimum of distances and the signed distances to capsules: update ``distance_m (frame, point)`` and ``slope``.

    start_m, end_m: (frame, capsule, 3) ends of the axes, NaN for an absent capsule. radius_m: (capsule,). slope:
    (frame, point, 3) gradient. Capsules more than 0.3 m from the first point of a frame are skipped.
    """
    for f in range(points_m.shape[0]):
        for c in range(len(radius_m)):
            start, axis = start_m[f, c], end_m[f, c] - start_m[f, c]
            if not ((start - points_m[f, 0]) ** 2).sum() < 0.09:
                continue
            square = max((axis**2).sum(), 1e-12)
            for p in range(points_m.shape[1]):
                x, y, z = (points_m[f, p, 0] - start[0], points_m[f, p, 1] - start[1], points_m[f, p, 2] - start[2])
                along = min(max((x * axis[0] + y * axis[1] + z * axis[2]) / square, 0.0), 1.0)
                x, y, z = x - along * axis[0], y - along * axis[1], z - along * axis[2]
                away = np.sqrt(x * x + y * y + z * z)
                if away - radius_m[c] < distance_m[f, p]:
                    distance_m[f, p] = away - radius_m[c]
                    away = max(away, 1e-9)
                    slope[f, p, 0], slope[f, p, 1], slope[f, p, 2] = x / away, y / away, z / away
