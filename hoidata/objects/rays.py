"""Where rays meet the triangles of a tree, and which cubes they cut.

Compiled with numba, float64, one thread. All that call each other stand in this file: numba keeps compiled code by the
file it is in, and does not see a change in another. Rays are watertight (Woop et al. 2013): one that meets an edge or a
corner meets one of its triangles.
"""

import numpy as np
from numba import njit

from hoidata.objects.triangle_tree import DEEPEST

ENTERING, LEAVING, EITHER = -1, 1, 0
FEW = 16  # triangles
_CLEARLY = 1e-9
_WIDER = 1 + 1e-9  # boxes are left out only when they are clearly missed


@njit(cache=True)
def first_hits(tree, start_m, direction, reach_m, facing, way_m):  # pragma: no cover (compiled)
    """Set ``way_m (ray,)`` to the way to the first triangle met, where that is less and not above ``reach_m (ray,)``.

    start_m, direction: (ray, 3), directions of length 1. facing: (ray,) ENTERING meets only triangles whose outward
    normal points against the ray, LEAVING only those along it, EITHER all; a triangle seen edge on is never met.
    """
    if len(tree[4]) <= FEW:  # looking at all takes less than asking which
        _first_hits_of_few(tree, start_m, direction, reach_m, facing, way_m)
        return
    stack, ways = np.empty(DEEPEST, np.int64), np.empty(DEEPEST)
    for ray in range(len(start_m)):
        best = min(reach_m[ray], way_m[ray])
        if _is_beyond(tree[1], start_m, direction, ray, best * _WIDER):
            continue
        found = _first_hit(tree, start_m[ray], direction[ray], best, facing[ray], stack, ways)
        if found >= 0:
            way_m[ray] = found


@njit(cache=True, error_model="numpy")
def _first_hits_of_few(tree, start_m, direction, reach_m, facing, way_m):  # pragma: no cover (compiled)
    """The same where there is nothing to choose: numbers alone, for views of arrays cost more than the triangles."""
    triangle, corner, vertices_m = tree[0], tree[4], tree[5]
    places = np.empty((len(corner), 3, 3))
    for number in range(len(corner)):
        for point in range(3):
            places[number, point] = vertices_m[corner[number, point]]
    for ray in range(len(start_m)):
        best = min(reach_m[ray], way_m[ray])
        if _is_beyond(tree[1], start_m, direction, ray, best * _WIDER):
            continue
        start = (start_m[ray, 0], start_m[ray, 1], start_m[ray, 2])
        way = (direction[ray, 0], direction[ray, 1], direction[ray, 2])
        kx, ky, kz, shear_x, shear_y, speed = _axes(way)
        for number in range(len(places)):
            if _is_missed(triangle, number, start, way, facing[ray], best):
                continue
            az = places[number, 0, kz] - start[kz]
            bz = places[number, 1, kz] - start[kz]
            cz = places[number, 2, kz] - start[kz]
            ax = places[number, 0, kx] - start[kx] - shear_x * az
            bx = places[number, 1, kx] - start[kx] - shear_x * bz
            cx = places[number, 2, kx] - start[kx] - shear_x * cz
            ay = places[number, 0, ky] - start[ky] - shear_y * az
            by = places[number, 1, ky] - start[ky] - shear_y * bz
            cy = places[number, 2, ky] - start[ky] - shear_y * cz
            found = _way_met(ax, ay, az, bx, by, bz, cx, cy, cz, facing[ray], speed)
            if 0 <= found <= best:
                best = way_m[ray] = found


@njit(cache=True, inline="always")
def _way_met(ax, ay, az, bx, by, bz, cx, cy, cz, facing, speed):  # pragma: no cover (compiled)
    """Way along the ray, which runs along the third axis, to a triangle abc; -1 where it is missed."""
    u, v, w = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
    area = u + v + w
    if min(u, v, w) < 0 < max(u, v, w) or area == 0 or area * facing > 0:
        return -1.0
    return (u * az + v * bz + w * cz) / area / speed


@njit(cache=True, inline="always")
def _is_beyond(box, start_m, direction, ray, reach):  # pragma: no cover (compiled)
    """Whether the way to ``reach`` lies on one side of all triangles: no division, and most rays of a hand do."""
    for axis in range(3):
        first = start_m[ray, axis]
        last = first + reach * direction[ray, axis]
        if max(first, last) < box[0, axis] - _CLEARLY or min(first, last) > box[0, axis + 3] + _CLEARLY:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _first_hit(tree, start, way, reach, facing, stack, ways):  # pragma: no cover (compiled)
    """Way to the first triangle met within ``reach``; -1 where there is none. way: the ray's direction."""
    box, link, axes = tree[1], tree[2], _axes(way)
    over = (1 / way[0], 1 / way[1], 1 / way[2])
    best, hit, waiting = reach, -1.0, 1
    stack[0], ways[0] = 0, _way_to_box(box, 0, start, over)
    while waiting:
        waiting -= 1
        node = stack[waiting]
        if ways[waiting] > best * _WIDER:
            continue
        second = link[node, 0]
        if second:
            near, far = node + 1, second
            near_way, far_way = _way_to_box(box, near, start, over), _way_to_box(box, far, start, over)
            if far_way < near_way:
                near, far, near_way, far_way = far, near, far_way, near_way
            for child, child_way in ((far, far_way), (near, near_way)):
                if child_way <= best * _WIDER:
                    stack[waiting], ways[waiting] = child, child_way
                    waiting += 1
            continue
        found = _hit_in_leaf(tree, link[node, 1], link[node, 2], start, way, axes, facing, best)
        if found >= 0:
            best, hit = found, found
    return hit


@njit(cache=True, inline="always")
def _axes(way):  # pragma: no cover (compiled)
    """The axis a ray runs along most, last, and the two others, so that orientation stays; its shear along them."""
    x, y, z = abs(way[0]), abs(way[1]), abs(way[2])
    kz = 0 if x >= y and x >= z else 1 if y >= z else 2
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    if way[kz] < 0:
        kx, ky = ky, kx
    return kx, ky, kz, way[kx] / way[kz], way[ky] / way[kz], way[kz]


@njit(cache=True)
def _hit_in_leaf(tree, first, last, start, way, axes, facing, best):  # pragma: no cover (compiled)
    """Way to the first of some triangles that is met within ``best``; -1 where none is."""
    triangle, corner, vertices_m = tree[0], tree[4], tree[5]
    kx, ky, kz, shear_x, shear_y, speed = axes
    hit = -1.0
    for number in range(first, last):
        if _is_missed(triangle, number, start, way, facing, best):
            continue
        ax, ay, az = _sheared(vertices_m, corner[number, 0], start, kx, ky, kz, shear_x, shear_y)
        bx, by, bz = _sheared(vertices_m, corner[number, 1], start, kx, ky, kz, shear_x, shear_y)
        cx, cy, cz = _sheared(vertices_m, corner[number, 2], start, kx, ky, kz, shear_x, shear_y)
        far = _way_met(ax, ay, az, bx, by, bz, cx, cy, cz, facing, speed)
        if 0 <= far <= best:
            best, hit = far, far
    return hit


@njit(cache=True, inline="always")
def _is_missed(triangle, number, start, way, facing, best):  # pragma: no cover (compiled)
    """Whether a ray clearly meets a triangle's plane from the wrong side, behind its start or beyond ``best``."""
    nx, ny, nz = triangle[9, number], triangle[10, number], triangle[11, number]
    along = nx * way[0] + ny * way[1] + nz * way[2]
    if facing * along < -_CLEARLY:
        return True
    height = nx * (triangle[0, number] - start[0]) + ny * (triangle[1, number] - start[1])
    height += nz * (triangle[2, number] - start[2])
    if along < 0:
        along, height = -along, -height
    return height < -_CLEARLY or height > along * best + _CLEARLY


@njit(cache=True, inline="always")
def _sheared(vertices_m, vertex, start, kx, ky, kz, shear_x, shear_y):  # pragma: no cover (compiled)
    """A corner seen from the start of the ray, sheared so that the ray runs along the third axis."""
    z = vertices_m[vertex, kz] - start[kz]
    x = vertices_m[vertex, kx] - start[kx] - shear_x * z
    y = vertices_m[vertex, ky] - start[ky] - shear_y * z
    return x, y, z


@njit(cache=True, inline="always")
def _way_to_box(box, node, start, over):  # pragma: no cover (compiled)
    """Way along the ray to a node's box, 0 inside, infinite where it is missed. over: 1 / direction, infinite for 0."""
    enter, leave = 0.0, np.inf
    for axis in range(3):
        low, high = box[node, axis] - start[axis], box[node, axis + 3] - start[axis]
        if abs(over[axis]) == np.inf:
            if low > 0 or high < 0:
                return np.inf
        else:
            first, last = low * over[axis], high * over[axis]
            enter, leave = max(enter, min(first, last)), min(leave, max(first, last))
    return enter if enter <= leave * _WIDER else np.inf


@njit(cache=True)
def mark_cut_cubes(tree, middle_m, turn, half_m, cut):  # pragma: no cover (compiled)
    """Set ``cut (cube,)`` where a triangle meets the cube about ``middle_m (cube, 3)``; marked ones are not looked at.

    turn: (cube, 3, 3), columns are the edges' directions. half_m: half an edge. Touching counts.
    """
    box, link, corner, vertices_m = tree[1], tree[2], tree[4], tree[5]
    stack, around = np.empty(DEEPEST, np.int64), half_m * np.sqrt(3.0)
    triangle = np.empty((3, 3))
    for cube in range(len(middle_m)):
        if not cut[cube]:
            middle = middle_m[cube]
            cut[cube] = _is_cut(box, link, corner, vertices_m, middle, turn[cube], half_m, around, stack, triangle)


@njit(cache=True)
def _is_cut(box, link, corner, vertices_m, middle, turn, half, around, stack, triangle):  # pragma: no cover (compiled)
    waiting = 1
    stack[0] = 0
    while waiting:
        waiting -= 1
        node = stack[waiting]
        square = 0.0
        for axis in range(3):
            off = max(box[node, axis] - middle[axis], middle[axis] - box[node, axis + 3], 0.0)
            square += off * off
        if square > around * around * _WIDER:
            continue
        second = link[node, 0]
        if second:
            stack[waiting], stack[waiting + 1] = second, node + 1
            waiting += 2
            continue
        for number in range(link[node, 1], link[node, 2]):
            for point in range(3):
                for axis in range(3):
                    place = 0.0
                    for way in range(3):
                        place += turn[way, axis] * (vertices_m[corner[number, point], way] - middle[way])
                    triangle[point, axis] = place
            if _meets_cube(triangle, half):
                return True
    return False


@njit(cache=True)
def _meets_cube(triangle, half):  # pragma: no cover (compiled)
    """Whether a triangle (3, 3) meets the cube of half edge ``half`` about the origin: no axis separates the two.

    The axes (Akenine-Moeller 2001): the cube's, the triangle's normal, and those across both's edges.
    """
    for axis in range(3):
        low = min(triangle[0, axis], triangle[1, axis], triangle[2, axis])
        high = max(triangle[0, axis], triangle[1, axis], triangle[2, axis])
        if low > half or high < -half:
            return False
    ux, uy, uz = triangle[1, 0] - triangle[0, 0], triangle[1, 1] - triangle[0, 1], triangle[1, 2] - triangle[0, 2]
    vx, vy, vz = triangle[2, 0] - triangle[1, 0], triangle[2, 1] - triangle[1, 1], triangle[2, 2] - triangle[1, 2]
    if _apart(triangle, half, uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx):
        return False
    for edge in range(3):
        to = (edge + 1) % 3
        ex = triangle[to, 0] - triangle[edge, 0]
        ey = triangle[to, 1] - triangle[edge, 1]
        ez = triangle[to, 2] - triangle[edge, 2]
        if (
            _apart(triangle, half, 0.0, -ez, ey)
            or _apart(triangle, half, ez, 0.0, -ex)
            or _apart(triangle, half, -ey, ex, 0.0)
        ):
            return False
    return True


@njit(cache=True, inline="always")
def _apart(triangle, half, x, y, z):  # pragma: no cover (compiled)
    """Whether the axis (x, y, z) separates the triangle and the cube."""
    first = x * triangle[0, 0] + y * triangle[0, 1] + z * triangle[0, 2]
    second = x * triangle[1, 0] + y * triangle[1, 1] + z * triangle[1, 2]
    third = x * triangle[2, 0] + y * triangle[2, 1] + z * triangle[2, 2]
    reach = half * (abs(x) + abs(y) + abs(z))
    return min(first, second, third) > reach or max(first, second, third) < -reach
