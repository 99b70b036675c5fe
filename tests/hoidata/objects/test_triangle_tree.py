"""The tree of a mesh's triangles: every triangle lies in one leaf, and every box holds what is below it."""

import numpy as np
import pytest

from hoidata.objects.triangle_tree import LEAF, TriangleTree, triangle_tree


def _mesh(count: int, *, alike: bool = False) -> tuple[np.ndarray, np.ndarray]:
    drawn = np.random.default_rng(count)
    vertices = np.round(drawn.normal(size=(count + 2, 3)), 0 if alike else 12)
    return vertices, drawn.integers(0, count + 2, (count, 3))


def _halved(centre_m: np.ndarray, triangles: np.ndarray) -> list[int]:
    """Order of the triangles by the rule itself: sort across the longest side, halve, go on with both halves."""
    if len(triangles) <= LEAF:
        return triangles.tolist()
    centres = centre_m[triangles]
    axis = int(np.argmax(centres.max(axis=0) - centres.min(axis=0)))
    ordered = np.array(sorted(triangles.tolist(), key=lambda number: centre_m[number, axis]))  # sorted() is stable
    middle = LEAF * int(np.ceil(len(triangles) / (2 * LEAF)))
    return _halved(centre_m, ordered[:middle]) + _halved(centre_m, ordered[middle:])


def _nodes(tree: TriangleTree, node: int = 0) -> list[int]:
    """The numbers of a node and all below it, each parent first."""
    second = int(tree.link[node, 0])
    return [node] if not second else [node, *_nodes(tree, node + 1), *_nodes(tree, second)]


@pytest.mark.parametrize("count", [1, 8, 9, 17, 1000])
@pytest.mark.parametrize("alike", [False, True])
def test_triangles_are_halved_across_the_longest_side(count: int, alike: bool) -> None:
    vertices, faces = _mesh(count, alike=alike)
    corners = vertices[faces]
    centre = (corners.min(axis=1) + corners.max(axis=1)) / 2
    assert triangle_tree(vertices, faces).face.tolist() == _halved(centre, np.arange(count))


@pytest.mark.parametrize("count", [1, 9, 1000])
def test_boxes_contain_their_triangles_and_each_triangle_is_in_one_leaf(count: int) -> None:
    vertices, faces = _mesh(count)
    tree = triangle_tree(vertices, faces)
    assert _nodes(tree) == list(range(len(tree.link))) == list(range(len(tree.box)))
    corners = vertices[faces[tree.face]]
    members: list[int] = []
    for (second, start, stop), box in zip(tree.link, tree.box, strict=True):
        points = corners[start:stop].reshape(-1, 3)
        np.testing.assert_array_equal(box, np.concatenate([points.min(axis=0), points.max(axis=0)]))
        members += [] if second else range(start, stop)
        assert second or stop - start <= LEAF
    assert sorted(members) == list(range(count))


def _plate(axis: int) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[0.0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]])
    return np.roll(corners, axis, axis=1), np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("mesh", [*map(_mesh, (1, 9, 1000)), *map(_plate, range(3))])
def test_oriented_boxes_are_along_the_mean_normal_and_tight(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = mesh
    tree = triangle_tree(vertices, faces)
    corners = vertices[faces[tree.face]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    units = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    for (_, start, stop), oriented in zip(tree.link, tree.oriented_box, strict=True):
        first, second, low, high = oriented.reshape(4, 3)
        frame = np.stack([first, second, np.cross(first, second)])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        mean = units[start:stop].sum(axis=0)
        if np.linalg.norm(mean) > 1e-2:
            np.testing.assert_allclose(first, mean / np.linalg.norm(mean), atol=1e-9)
        places = corners[start:stop].reshape(-1, 3) @ frame.T
        rounding = 1e-8 * np.abs(corners[start:stop]).max()
        below, above = places.min(axis=0) - low, high - places.max(axis=0)
        assert np.minimum(below, above).min() > 0
        assert np.maximum(below, above).max() < rounding
