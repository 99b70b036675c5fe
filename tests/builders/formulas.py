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
    turns = [Rotation.from_rotvec(turn) for turn in np.concatenate((orient, fingers)).reshape(16, 3)]
    places, totals = [rest[0] + np.asarray(transl)], [turns[0]]
    for joint in range(1, 16):
        parent = PARENT[joint]
        places.append(places[parent] + totals[parent].apply(rest[joint] - rest[parent]))
        totals.append(totals[parent] * turns[joint])
    return np.array(places)


def joints_as_stored(track: HandTrack, model: HandModel, frame: int) -> np.ndarray:
    """(16, 3) joints of one frame from what a clip says: wrist, turn, bends, mesh, betas."""
    betas = track.betas[0 if len(track.betas) == 1 else frame].astype(np.float64)
    rest = rest_points(model, betas, track.template_m)
    wrist_m = track.wrist_m[frame].astype(np.float64)
    return chain(rest, track.global_orient[frame], track.hand_pose[frame].astype(np.float64), wrist_m - rest[0])


def off_m(found, other) -> float:
    """How far the farthest of some points is from its like."""
    return float(np.linalg.norm(np.asarray(found) - np.asarray(other), axis=-1).max())


def agrees(found, expected, *wrongs) -> None:
    """Points are where one convention puts them, and more than 5 mm from where others do."""
    assert off_m(found, expected) < EXACT_M
    for wrong in wrongs:
        assert off_m(found, wrong) > WRONG_M


# A person who sits at a table, looks along +y and has z up: palms down, fingers ahead, thumbs towards each other. At
# rest MANO's fingers lie along +x (left) or -x (right), its palms face -y and its thumbs point to +z; fingers bend
# about -z (left) or +z (right).
THIRD_TURN = 2 * np.pi / 3 / np.sqrt(3)
ORIENT = {"left": np.array([1.0, 1.0, 1.0]) * THIRD_TURN, "right": np.array([1.0, -1.0, -1.0]) * THIRD_TURN}
TRANSL = {"left": (-0.25, 0.05, 0.8), "right": (0.25, 0.02, 0.82)}
BEND = {"left": -0.6, "right": 0.6}
HALF_TURN = np.array([0.0, 0.0, np.pi])  # the same read by rows or by columns
AHEAD, TO_THE_RIGHT, UP = np.eye(3)[[1, 0, 2]]
FINGERS_THUMB_PALM = {"left": (AHEAD, TO_THE_RIGHT, -UP), "right": (AHEAD, -TO_THE_RIGHT, -UP)}


def seated_person(mirrored: int | None = None, swapped: bool = False) -> SimpleNamespace:
    """Her numbers: for each hand (orient, 45 finger angles, transl), and those of a thing turned by half a turn.

    mirrored: the axis whose sign a reader of the wrong handedness takes for the opposite (``signs`` for points; a
    rotation vector w becomes -M w). swapped: each side's numbers under the other side's name.
    """
    signs = np.where(np.arange(3) == mirrored, -1.0, 1.0)
    turn = -signs if mirrored is not None else signs
    other = {"left": "right", "right": "left"} if swapped else {"left": "left", "right": "right"}
    fingers = {side: np.concatenate((np.tile((0.0, 0.0, bend), 12), np.zeros(9))) for side, bend in BEND.items()}
    hands = {side: (ORIENT[of] * turn, fingers[of], TRANSL[of] * signs) for side, of in other.items()}
    return SimpleNamespace(hands=hands, named=other, signs=signs, object_orient=HALF_TURN * turn)


def hand_axes(joints: np.ndarray) -> np.ndarray:
    """Unit rows of (16, 3) joints of a bent hand: along the fingers, to the thumb's side, where the fingers bend to."""
    fingers = joints[4] - joints[0]
    thumb, palm = joints[13] - joints[7], joints[6] - joints[5]
    axes = [fingers, *(way - fingers * (way @ fingers) / (fingers @ fingers) for way in (thumb, palm))]
    return np.array(axes) / np.linalg.norm(axes, axis=1, keepdims=True)


def has_its_own_side(joints: dict[str, np.ndarray]) -> bool:
    """Fingers ahead, thumb to the right, palm down: a left hand, whose three directions turn as x, y, z do."""
    return all(np.linalg.det(hand_axes(joints[side])) * sign > 0.9 for side, sign in (("left", 1), ("right", -1)))


def sits_as_described(joints: dict[str, np.ndarray], edges: np.ndarray, edges_seen: np.ndarray) -> bool:
    """The right hand on her right, both as described, and the thing's edges where she sees them."""
    pairs = [(hand_axes(joints[side]), FINGERS_THUMB_PALM[side]) for side in joints] + [(edges, edges_seen)]
    cosines = [np.sum(found * seen, axis=1) / np.linalg.norm(found, axis=1) for found, seen in pairs]
    right_of_left = (joints["right"][0] - joints["left"][0]) @ TO_THE_RIGHT
    return bool(right_of_left > 0.3 and min(cosine.min() for cosine in cosines) > 0.9)
