"""Independent formulas for the joints of a posed hand: plain loops over the kinematic chain, rotations by SciPy."""

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips import HandTrack
from hoidata.hands import HandModel

PARENT = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
TIP_VERTEX = [317, 445, 673, 556, 745]
EXACT_M, WRONG_M = 1e-6, 0.005


def rest_points(model: HandModel, betas=None, template_m=None) -> np.ndarray:
    """(21, 3) joints and tips of the unposed hand in the model's frame."""
    vertices = model.template_m if template_m is None else template_m
    vertices = vertices + model.shape_directions @ (np.zeros(10) if betas is None else np.asarray(betas))
    return np.concatenate((model.joint_regressor @ vertices, vertices[TIP_VERTEX]))


def chain(rest: np.ndarray, orient, fingers, transl) -> np.ndarray:
    """(16, 3) joints of a bent hand, bone by bone; fingers: 45 absolute axis-angle numbers."""
    rotations = [Rotation.from_rotvec(rotvec) for rotvec in np.concatenate((orient, fingers)).reshape(16, 3)]
    positions, totals = [rest[0] + np.asarray(transl)], [rotations[0]]
    for joint in range(1, 16):
        parent = PARENT[joint]
        positions.append(positions[parent] + totals[parent].apply(rest[joint] - rest[parent]))
        totals.append(totals[parent] * rotations[joint])
    return np.array(positions)


def joints_as_stored(track: HandTrack, model: HandModel, frame: int) -> np.ndarray:
    """(16, 3) joints of one frame from the stored wrist, orientation, finger pose, mesh and betas."""
    betas = track.betas[0 if len(track.betas) == 1 else frame].astype(np.float64)
    rest = rest_points(model, betas, track.template_m)
    wrist_m = track.wrist_m[frame].astype(np.float64)
    return chain(rest, track.global_orient[frame], track.hand_pose[frame].astype(np.float64), wrist_m - rest[0])


def off_m(actual, other) -> float:
    """Largest distance between corresponding points."""
    return float(np.linalg.norm(np.asarray(actual) - np.asarray(other), axis=-1).max())


def agrees(actual, expected, *wrongs) -> None:
    """Check that points agree with one convention and are more than 5 mm from the results of others."""
    assert off_m(actual, expected) < EXACT_M
    for wrong in wrongs:
        assert off_m(actual, wrong) > WRONG_M


# A person who sits at a table, looks along +y and has z up: palms down, fingers ahead, thumbs towards each other. At
# rest MANO's fingers lie along +x (left) or -x (right), its palms face -y and its thumbs point to +z; fingers bend
# about -z (left) or +z (right).
THIRD_TURN = 2 * np.pi / 3 / np.sqrt(3)
ORIENT = {"left": np.array([1.0, 1.0, 1.0]) * THIRD_TURN, "right": np.array([1.0, -1.0, -1.0]) * THIRD_TURN}
TRANSL = {"left": (-0.25, 0.05, 0.8), "right": (0.25, 0.02, 0.82)}
BEND = {"left": -0.6, "right": 0.6}
HALF_TURN = np.array([0.0, 0.0, np.pi])  # equal for row and column vectors
AHEAD, TO_THE_RIGHT, UP = np.eye(3)[[1, 0, 2]]
FINGERS_THUMB_PALM = {"left": (AHEAD, TO_THE_RIGHT, -UP), "right": (AHEAD, -TO_THE_RIGHT, -UP)}


def seated_person(mirrored: int | None = None, swapped: bool = False) -> SimpleNamespace:
    """Parameters of a seated person's hands (orient, 45 finger angles, transl) and of an object rotated by pi.

    Args:
        mirrored: the axis that a reader of the wrong handedness mirrors: ``signs`` for points; a rotation vector w
            becomes -M w.
        swapped: exchange the parameters of left and right.
    """
    signs = np.where(np.arange(3) == mirrored, -1.0, 1.0)
    mirror_signs = -signs if mirrored is not None else signs
    other = {"left": "right", "right": "left"} if swapped else {"left": "left", "right": "right"}
    fingers = {side: np.concatenate((np.tile((0.0, 0.0, bend), 12), np.zeros(9))) for side, bend in BEND.items()}
    hands = {side: (ORIENT[of] * mirror_signs, fingers[of], TRANSL[of] * signs) for side, of in other.items()}
    return SimpleNamespace(hands=hands, named=other, signs=signs, object_orient=HALF_TURN * mirror_signs)


def hand_axes(joints: np.ndarray) -> np.ndarray:
    """Unit axes of a bent hand with (16, 3) joints: along the fingers, to the thumb's side, bending direction."""
    fingers = joints[4] - joints[0]
    thumb, palm = joints[13] - joints[7], joints[6] - joints[5]
    across = [side - fingers * (side @ fingers) / (fingers @ fingers) for side in (thumb, palm)]
    axes = [fingers, *across]
    return np.array(axes) / np.linalg.norm(axes, axis=1, keepdims=True)


def has_correct_handedness(joints: dict[str, np.ndarray]) -> bool:
    """Whether both hands have the correct handedness: a left hand's axes are right-handed."""
    return all(np.linalg.det(hand_axes(joints[side])) * sign > 0.9 for side, sign in (("left", 1), ("right", -1)))


def is_seated_correctly(joints: dict[str, np.ndarray], edges: np.ndarray, edges_seen: np.ndarray) -> bool:
    """Whether the right hand is on the person's right, and hand axes and object edges are as expected."""
    pairs = [(hand_axes(joints[side]), FINGERS_THUMB_PALM[side]) for side in joints] + [(edges, edges_seen)]
    cosines = [np.sum(actual * expected, axis=1) / np.linalg.norm(actual, axis=1) for actual, expected in pairs]
    right_of_left = (joints["right"][0] - joints["left"][0]) @ TO_THE_RIGHT
    return bool(right_of_left > 0.3 and min(cosine.min() for cosine in cosines) > 0.9)
