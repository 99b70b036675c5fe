"""Intersections of a triangle tree with rays and with cubes.

Compiled with numba, float64, one thread. Functions that call each other are in one file, because numba's cache is
invalidated only by a change of the file itself. Rays are watertight (Woop et al. 2013): a ray through an edge or a
corner hits one of its triangles.
"""

import numpy as np
from numba import njit

from hoidata.objects.triangle_tree import DEEPEST

ENTERING, LEAVING, EITHER = -1, 1, 0
_FEW = 16  # triangles up to which testing all is faster than searching the tree
_TOLERANCE = 1e-9  # metres or cosine: a quick rejection needs this margin
_WIDEN = 1 + 1e-9  # of search bounds: rounding must not skip a box that a ray touches


@njit(cache=True)
def first_hits(tree, start_m, direction, reach_m, facing, hit_m):  # pragma: no cover (compiled)
    """Lower ``hit_m`` to the distance of each ray's first hit, if that is at most ``reach_m``.

    Args:
        start_m: (ray, 3) origins.
        direction: (ray, 3) unit vectors.
        reach_m: (ray,) length of each ray.
        facing: (ray,) ENTERING hits only triangles whose outward normal is against the ray, LEAVING only those along
            it, EITHER all. A triangle parallel to the ray is never hit.
        hit_m: (ray,) input and output.
    """
    if len(tree[4]) <= _FEW:
        _first_hits_of_few(tree, start_m, direction, reach_m, facing, hit_m)
        return
    stack, box_distances = np.empty(DEEPEST, np.int64), np.empty(DEEPEST)
    for ray in range(len(start_m)):
        best = min(reach_m[ray], hit_m[ray])
        if _is_beyond(tree[1], start_m, direction, ray, best * _WIDEN):
            continue
        distance = _first_hit(tree, start_m[ray], direction[ray], best, facing[ray], stack, box_distances)
        if distance >= 0:
            hit_m[ray] = distance


@njit(cache=True, error_model="numpy")
def _first_hits_of_few(tree, start_m, direction, reach_m, facing, hit_m):  # pragma: no cover (compiled)
    """``first_hits`` without a tree search. Scalars instead of array views, which cost more than the triangles."""
    triangle, corner, vertices_m = tree[0], tree[4], tree[5]
    corners_m = np.empty((len(corner), 3, 3))
    for number in range(len(corner)):
        for vertex in range(3):
            corners_m[number, vertex] = vertices_m[corner[number, vertex]]
    for ray in range(len(start_m)):
        best = min(reach_m[ray], hit_m[ray])
        if _is_beyond(tree[1], start_m, direction, ray, best * _WIDEN):
            continue
        start = (start_m[ray, 0], start_m[ray, 1], start_m[ray, 2])
        ray_direction = (direction[ray, 0], direction[ray, 1], direction[ray, 2])
        kx, ky, kz, shear_x, shear_y, speed = _axes(ray_direction)
        for number in range(len(corners_m)):
            if _is_excluded(triangle, number, start, ray_direction, facing[ray], best):
                continue
            az = corners_m[number, 0, kz] - start[kz]
            bz = corners_m[number, 1, kz] - start[kz]
            cz = corners_m[number, 2, kz] - start[kz]
            ax = corners_m[number, 0, kx] - start[kx] - shear_x * az
            bx = corners_m[number, 1, kx] - start[kx] - shear_x * bz
            cx = corners_m[number, 2, kx] - start[kx] - shear_x * cz
            ay = corners_m[number, 0, ky] - start[ky] - shear_y * az
            by = corners_m[number, 1, ky] - start[ky] - shear_y * bz
            cy = corners_m[number, 2, ky] - start[ky] - shear_y * cz
            distance = _hit_distance(ax, ay, az, bx, by, bz, cx, cy, cz, facing[ray], speed)
            if 0 <= distance <= best:
                best = hit_m[ray] = distance


@njit(cache=True, inline="always")
def _hit_distance(ax, ay, az, bx, by, bz, cx, cy, cz, facing, speed):  # pragma: no cover (compiled)
    """Distance along the ray, sheared to the third axis, to a triangle abc; -1 for a miss."""
    # Edge functions: their sum is the doubled area of the projected triangle, their signs tell inside from outside.
    u, v, w = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
    area = u + v + w
    if min(u, v, w) < 0 < max(u, v, w) or area == 0 or area * facing > 0:
        return -1.0
    return (u * az + v * bz + w * cz) / area / speed


@njit(cache=True, inline="always")
def _is_beyond(box, start_m, direction, ray, reach):  # pragma: no cover (compiled)
    """Whether the ray up to ``reach`` misses the bounding box on one side, as most rays of a hand do."""
    for axis in range(3):
        first = start_m[ray, axis]
        last = first + reach * direction[ray, axis]
        if max(first, last) < box[0, axis] - _TOLERANCE or min(first, last) > box[0, axis + 3] + _TOLERANCE:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _first_hit(tree, start, direction, reach, facing, stack, box_distances):  # pragma: no cover (compiled)
    """Distance to the first triangle hit within ``reach``; -1 for a miss."""
    box, link, axes = tree[1], tree[2], _axes(direction)
    inverse = (1 / direction[0], 1 / direction[1], 1 / direction[2])
    best, hit, size = reach, -1.0, 1
    stack[0], box_distances[0] = 0, _distance_to_box(box, 0, start, inverse)
    while size:
        size -= 1
        node = stack[size]
        if box_distances[size] > best * _WIDEN:
            continue
        second = link[node, 0]
        if second:
            near, far = node + 1, second
            near_distance = _distance_to_box(box, near, start, inverse)
            far_distance = _distance_to_box(box, far, start, inverse)
            if far_distance < near_distance:
                near, far, near_distance, far_distance = far, near, far_distance, near_distance
            # Push the nearer child last, so that it is searched first.
            for child, child_distance in ((far, far_distance), (near, near_distance)):
                if child_distance <= best * _WIDEN:
                    stack[size], box_distances[size] = child, child_distance
                    size += 1
            continue
        distance = _hit_in_leaf(tree, link[node, 1], link[node, 2], start, direction, axes, facing, best)
        if distance >= 0:
            best, hit = distance, distance
    return hit


@njit(cache=True, inline="always")
def _axes(direction):  # pragma: no cover (compiled)
    """Axes (kx, ky, kz) with the ray's dominant axis last and orientation kept, and the shear along x and y."""
    x, y, z = abs(direction[0]), abs(direction[1]), abs(direction[2])
    kz = 0 if x >= y and x >= z else 1 if y >= z else 2
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    if direction[kz] < 0:
        kx, ky = ky, kx
    return kx, ky, kz, direction[kx] / direction[kz], direction[ky] / direction[kz], direction[kz]


@njit(cache=True)
def _hit_in_leaf(tree, first, last, start, direction, axes, facing, best):  # pragma: no cover (compiled)
    """Distance to the first of a leaf's triangles hit within ``best``; -1 for a miss."""
    triangle, corner, vertices_m = tree[0], tree[4], tree[5]
    kx, ky, kz, shear_x, shear_y, speed = axes
    hit = -1.0
    for number in range(first, last):
        if _is_excluded(triangle, number, start, direction, facing, best):
            continue
        ax, ay, az = _sheared(vertices_m, corner[number, 0], start, kx, ky, kz, shear_x, shear_y)
        bx, by, bz = _sheared(vertices_m, corner[number, 1], start, kx, ky, kz, shear_x, shear_y)
        cx, cy, cz = _sheared(vertices_m, corner[number, 2], start, kx, ky, kz, shear_x, shear_y)
        distance = _hit_distance(ax, ay, az, bx, by, bz, cx, cy, cz, facing, speed)
        if 0 <= distance <= best:
            best, hit = distance, distance
    return hit


@njit(cache=True, inline="always")
def _is_excluded(triangle, number, start, direction, facing, best):  # pragma: no cover (compiled)
    """Whether a ray hits a triangle's plane on the wrong side, behind its start or beyond ``best``, by a margin."""
    nx, ny, nz = triangle[9, number], triangle[10, number], triangle[11, number]
    along = nx * direction[0] + ny * direction[1] + nz * direction[2]
    if facing * along < -_TOLERANCE:
        return True
    height = nx * (triangle[0, number] - start[0]) + ny * (triangle[1, number] - start[1])
    height += nz * (triangle[2, number] - start[2])
    if along < 0:
        along, height = -along, -height
    return height < -_TOLERANCE or height > along * best + _TOLERANCE


@njit(cache=True, inline="always")
def _sheared(vertices_m, vertex, start, kx, ky, kz, shear_x, shear_y):  # pragma: no cover (compiled)
    """A corner relative to the ray's origin, sheared so that the ray is along the third axis."""
    z = vertices_m[vertex, kz] - start[kz]
    x = vertices_m[vertex, kx] - start[kx] - shear_x * z
    y = vertices_m[vertex, ky] - start[ky] - shear_y * z
    return x, y, z


@njit(cache=True, inline="always")
def _distance_to_box(box, node, start, inverse):  # pragma: no cover (compiled)
    """Distance along the ray to a node's box, 0 inside, infinite for a miss; ``inverse`` is 1 / direction."""
    enter, leave = 0.0, np.inf
    for axis in range(3):
        low, high = box[node, axis] - start[axis], box[node, axis + 3] - start[axis]
        if abs(inverse[axis]) == np.inf:
            if low > 0 or high < 0:
                return np.inf
        else:
            t_low, t_high = low * inverse[axis], high * inverse[axis]
            enter, leave = max(enter, min(t_low, t_high)), min(leave, max(t_low, t_high))
    return enter if enter <= leave * _WIDEN else np.inf


@njit(cache=True)
def mark_cut_cubes(tree, centre_m, rotation, half_m, cut):  # pragma: no cover (compiled)
    """Set ``cut (cube,)`` for cubes that a triangle intersects or touches; marked cubes are skipped.

    Args:
        centre_m: (cube, 3).
        rotation: (cube, 3, 3), columns are the directions of the edges.
        half_m: half an edge.
        cut: (cube,) bool, input and output.
    """
    box, link, corner, vertices_m = tree[1], tree[2], tree[4], tree[5]
    stack, radius = np.empty(DEEPEST, np.int64), half_m * np.sqrt(3.0)
    triangle = np.empty((3, 3))
    for cube in range(len(centre_m)):
        if not cut[cube]:
            centre = centre_m[cube]
            cut[cube] = _is_cut(box, link, corner, vertices_m, centre, rotation[cube], half_m, radius, stack, triangle)


@njit(cache=True)
def _is_cut(
    box, link, corner, vertices_m, centre, rotation, half, radius, stack, triangle
):  # pragma: no cover (compiled)
    size = 1
    stack[0] = 0
    while size:
        size -= 1
        node = stack[size]
        square = 0.0
        for axis in range(3):
            gap = max(box[node, axis] - centre[axis], centre[axis] - box[node, axis + 3], 0.0)
            square += gap * gap
        if square > radius * radius * _WIDEN:
            continue
        second = link[node, 0]
        if second:
            stack[size], stack[size + 1] = second, node + 1
            size += 2
            continue
        for number in range(link[node, 1], link[node, 2]):
            for vertex in range(3):
                for axis in range(3):
                    coordinate = 0.0
                    for world_axis in range(3):
                        coordinate += rotation[world_axis, axis] * (
                            vertices_m[corner[number, vertex], world_axis] - centre[world_axis]
                        )
                    triangle[vertex, axis] = coordinate
            if _meets_cube(triangle, half):
                return True
    return False


@njit(cache=True)
def _meets_cube(triangle, half):  # pragma: no cover (compiled)
    """Whether a triangle (3, 3) intersects the cube of half edge ``half`` about the origin.

    Separating-axis test (Akenine-Moeller 2001): cube axes, triangle normal, and cross products of their edges.
    """
    for axis in range(3):
        low = min(triangle[0, axis], triangle[1, axis], triangle[2, axis])
        high = max(triangle[0, axis], triangle[1, axis], triangle[2, axis])
        if low > half or high < -half:
            return False
    ux, uy, uz = triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    vx, vy, vz = triangle[2, 0] - triangle[1, 0], triangle[2, 1] - triangle[1, 1], triangle[2, 2] - triangle[1, 2]
    if _separates(triangle, half, uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx):
        return False
    for edge in range(3):
        next_corner = (edge + 1) % 3
        ex = triangle[next_corner, 0] - triangle[edge, 0]
        ey = triangle[next_corner, 1] - triangle[edge, 1]
        ez = triangle[next_corner, 2] - triangle[edge, 2]
        if (
            _separates(triangle, half, 0.0, -ez, ey)
            or _separates(triangle, half, ez, 0.0, -ex)
            or _separates(triangle, half, -ey, ex, 0.0)
        ):
            return False
    return True


@njit(cache=True, inline="always")
def _separates(triangle, half, x, y, z):  # pragma: no cover (compiled)
    """Whether the axis (x, y, z) separates the triangle and the cube."""
    first = x * triangle[0, 0] + y * triangle[0, 1] + z * triangle[0, 2]
    second = x * triangle[1, 0] + y * triangle[1, 1] + z * triangle[1, 2]
    third = x * triangle[2, 0] + y * triangle[2, 1] + z * triangle[2, 2]
    reach = half * (abs(x) + abs(y) + abs(z))
    return min(first, second, third) > reach or max(first, second, third) < -reach
