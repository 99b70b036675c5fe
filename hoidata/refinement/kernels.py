"""Derivatives of skinned vertices, and distances with their slope: the loops of the refinement, compiled.

The unknowns of one hand in one frame are 51: the wrist's place 3, a small turn of the whole hand about it 3 (world
axes, applied from the left), and the axis-angles of the 15 finger joints 45. float64, one thread. All that call each
other stand in this file: numba keeps compiled code by the file it is in, and does not see a change in another.
"""

import numpy as np
from numba import njit

N_UNKNOWNS = 51
_PARENT = np.array((-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14))


@njit(cache=True)
def place_joints(turns, bone, rotation, position):  # pragma: no cover (compiled)
    """Set ``rotation (frame, 16, 3, 3)`` and ``position (frame, 16, 3)`` of all joints after the wrist, which are set.

    turns: (frame, 15, 3, 3) local rotations. bone: (15, 3) from each joint's parent to it, at rest.
    """
    for f in range(len(turns)):
        for j in range(1, 16):
            p = _PARENT[j]
            for a in range(3):
                position[f, j, a] = position[f, p, a]
                for b in range(3):
                    position[f, j, a] += rotation[f, p, a, b] * bone[j - 1, b]
                for c in range(3):
                    total = 0.0
                    for b in range(3):
                        total += rotation[f, p, a, b] * turns[f, j - 1, b, c]
                    rotation[f, j, a, c] = total


@njit(cache=True)
def skin_vertices(weight, rest_joint, rotation, position, rested, out):  # pragma: no cover (compiled)
    """Set ``out (frame, vertex, 3)`` to where joints put vertices ``rested (frame, vertex, 3)``.

    weight: (vertex, 16). rest_joint: (16, 3). rotation, position: of the joints, (frame, 16, 3, 3) and (frame, 16, 3).
    """
    shift = np.empty((16, 3))
    for f in range(len(rested)):
        for j in range(16):
            for a in range(3):
                shift[j, a] = position[f, j, a]
                for b in range(3):
                    shift[j, a] -= rotation[f, j, a, b] * rest_joint[j, b]
        for v in range(len(weight)):
            x, y, z = rested[f, v, 0], rested[f, v, 1], rested[f, v, 2]
            to_x, to_y, to_z = 0.0, 0.0, 0.0
            for j in range(16):
                w = weight[v, j]
                if w != 0.0:
                    turn = rotation[f, j]
                    to_x += w * (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[j, 0])
                    to_y += w * (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[j, 1])
                    to_z += w * (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[j, 2])
            out[f, v, 0], out[f, v, 1], out[f, v, 2] = to_x, to_y, to_z


@njit(cache=True)
def vertex_derivatives(frame, vertex, skin, chain, out):  # pragma: no cover (compiled)
    """Set ``out (pair, 3, 51)`` to the derivatives of the vertices ``vertex (pair,)`` in the frames ``frame (pair,)``.

    skin: weights (vertex, 16), rest joints (16, 3), pose directions (vertex, 3, 135), whether a vertex feels a joint's
    pose (vertex, 16). chain: world rotations (frame, 16, 3, 3) and positions (frame, 16, 3) of the joints, world axes
    (frame, 16, 3, 3) of their unknowns in columns, derivatives (frame, 15, 9, 3) of the local rotations, and the
    vertices (frame, vertex, 3) at rest.
    """
    weight, rest_joint, pose_direction, feels = skin
    rotation, position, axis, local, rested = chain
    moment, share, blend = np.empty((16, 3)), np.empty(16), np.empty((3, 3))
    for pair in range(len(frame)):
        f, v = frame[pair], vertex[pair]
        _gather(weight[v], rest_joint, rotation[f], position[f], rested[f, v], moment, share, blend)
        out[pair] = 0.0
        for a in range(3):
            out[pair, a, a] = 1.0
        for j in range(16):
            if share[j] != 0.0:
                x = moment[j, 0] - share[j] * position[f, j, 0]
                y = moment[j, 1] - share[j] * position[f, j, 1]
                z = moment[j, 2] - share[j] * position[f, j, 2]
                for c in range(3):
                    along, up, ahead = axis[f, j, 0, c], axis[f, j, 1, c], axis[f, j, 2, c]
                    out[pair, 0, 3 + 3 * j + c] = up * z - ahead * y
                    out[pair, 1, 3 + 3 * j + c] = ahead * x - along * z
                    out[pair, 2, 3 + 3 * j + c] = along * y - up * x
            if feels[v, j]:
                _add_bend(pose_direction[v, :, 9 * j - 9 : 9 * j], local[f, j - 1], blend, 3 + 3 * j, out[pair])


@njit(cache=True)
def _gather(weight, rest_joint, rotation, position, rested, moment, share, blend):  # pragma: no cover (compiled)
    """Of one vertex: the weight of each joint and all beyond it (share), the sum of weight times the place they put the
    vertex at (moment), and the blended rotation (blend)."""
    moment[:], share[:], blend[:] = 0.0, weight, 0.0
    for j in range(16):
        w = weight[j]
        if w == 0.0:
            continue
        for a in range(3):
            total = position[j, a]
            for b in range(3):
                total += rotation[j, a, b] * (rested[b] - rest_joint[j, b])
                blend[a, b] += w * rotation[j, a, b]
            moment[j, a] = w * total
    for j in range(15, 0, -1):
        share[_PARENT[j]] += share[j]
        moment[_PARENT[j]] += moment[j]


@njit(cache=True)
def _add_bend(direction, local, blend, column, out):  # pragma: no cover (compiled)
    """Add how one joint's pose corrective moves the vertex: direction (3, 9), local (9, 3), out (3, 51)."""
    for c in range(3):
        for a in range(3):
            rest = 0.0
            for e in range(9):
                rest += direction[a, e] * local[e, c]
            for b in range(3):
                out[b, column + c] += blend[b, a] * rest


@njit(cache=True)
def add_squares(frame, slope, derivative, weight, miss, matrix, vector):  # pragma: no cover (compiled)
    """Add ``weight (pair,)`` times the square of residuals ``miss (pair,)`` to the normal equations of their frames.

    The derivative of a residual is ``slope (pair, 3) @ derivative (pair, 3, 51)``. matrix: (frame, 51, 51), lower
    triangle; vector: (frame, 51), minus half the gradient.
    """
    row = np.empty(N_UNKNOWNS)
    for pair in range(len(frame)):
        f = frame[pair]
        for i in range(N_UNKNOWNS):
            row[i] = 0.0
            for a in range(3):
                row[i] += slope[pair, a] * derivative[pair, a, i]
        for i in range(N_UNKNOWNS):
            if row[i] != 0.0:
                scaled = weight[pair] * row[i]
                vector[f, i] -= scaled * miss[pair]
                for j in range(i + 1):
                    matrix[f, i, j] += scaled * row[j]


@njit(cache=True)
def lower_signed(low_m, cell_m, value, rotation, offset, places_m, distance_m, slope):  # pragma: no cover (compiled)
    """Where the surface of a grid is nearer than ``distance_m (frame, place)``, set it and its ``slope`` (..., 3).

    value: (z, y, x) signed distances, node (0, 0, 0) at low_m (3,), cell_m apart. rotation, offset: part-from-world of
    each frame. places_m: (frame, place, 3), world; the slope is turned to the world too. Off the grid the way to it is
    added to the value at its rim.
    """
    last_x, last_y, last_z = value.shape[2] - 1, value.shape[1] - 1, value.shape[0] - 1
    for f in range(places_m.shape[0]):
        turn, shift = rotation[f], offset[f]
        for p in range(places_m.shape[1]):
            wx, wy, wz = places_m[f, p, 0], places_m[f, p, 1], places_m[f, p, 2]
            far_u = (turn[0, 0] * wx + turn[0, 1] * wy + turn[0, 2] * wz + shift[0] - low_m[0]) / cell_m
            far_v = (turn[1, 0] * wx + turn[1, 1] * wy + turn[1, 2] * wz + shift[1] - low_m[1]) / cell_m
            far_w = (turn[2, 0] * wx + turn[2, 1] * wy + turn[2, 2] * wz + shift[2] - low_m[2]) / cell_m
            u, v, w = min(max(far_u, 0.0), last_x), min(max(far_v, 0.0), last_y), min(max(far_w, 0.0), last_z)
            way_u, way_v, way_w = far_u - u, far_v - v, far_w - w
            way = np.sqrt(way_u * way_u + way_v * way_v + way_w * way_w)
            i, j, k = min(int(u), last_x - 1), min(int(v), last_y - 1), min(int(w), last_z - 1)
            u, v, w = u - i, v - j, w - k
            a, b = value[k, j, i], value[k, j, i + 1]
            c, d = value[k, j + 1, i], value[k, j + 1, i + 1]
            e, g = value[k + 1, j, i], value[k + 1, j, i + 1]
            h, m = value[k + 1, j + 1, i], value[k + 1, j + 1, i + 1]
            below, above = a + u * (b - a), c + u * (d - c)
            below_up, above_up = e + u * (g - e), h + u * (m - h)
            near, near_up = below + v * (above - below), below_up + v * (above_up - below_up)
            found = near + w * (near_up - near) + way * cell_m
            if not found < distance_m[f, p]:
                continue
            distance_m[f, p] = found
            first, second = (b - a) + v * ((d - c) - (b - a)), (g - e) + v * ((m - h) - (g - e))
            su = (first + w * (second - first)) / cell_m if way_u == 0.0 else way_u / way
            sv = ((above - below) + w * ((above_up - below_up) - (above - below))) / cell_m
            sv = sv if way_v == 0.0 else way_v / way
            sw = (near_up - near) / cell_m if way_w == 0.0 else way_w / way
            for axis in range(3):
                slope[f, p, axis] = turn[0, axis] * su + turn[1, axis] * sv + turn[2, axis] * sw


@njit(cache=True)
def lower_capsules(start_m, end_m, radius_m, places_m, distance_m, slope):  # pragma: no cover (compiled)
    """Where a capsule is nearer than ``distance_m (frame, place)``, set it and its ``slope (frame, place, 3)``.

    start_m, end_m: (frame, capsule, 3) ends of the axes; radius_m: (capsule,). NaN: not there. Capsules more than
    0.3 m from the first place of a frame are not looked at.
    """
    for f in range(places_m.shape[0]):
        for c in range(len(radius_m)):
            start, axis = start_m[f, c], end_m[f, c] - start_m[f, c]
            if not ((start - places_m[f, 0]) ** 2).sum() < 0.09:
                continue
            square = max((axis**2).sum(), 1e-12)
            for p in range(places_m.shape[1]):
                x, y, z = (places_m[f, p, 0] - start[0], places_m[f, p, 1] - start[1], places_m[f, p, 2] - start[2])
                along = min(max((x * axis[0] + y * axis[1] + z * axis[2]) / square, 0.0), 1.0)
                x, y, z = x - along * axis[0], y - along * axis[1], z - along * axis[2]
                away = np.sqrt(x * x + y * y + z * z)
                if away - radius_m[c] < distance_m[f, p]:
                    distance_m[f, p] = away - radius_m[c]
                    away = max(away, 1e-9)
                    slope[f, p, 0], slope[f, p, 1], slope[f, p, 2] = x / away, y / away, z / away
