"""Joint orders against the lists their libraries publish."""

import numpy as np

from hoidata.hands import JOINT_NAMES
from hoidata.hands.model import OPENPOSE, openpose_to_mano_order

# smplx and MANO: wrist, index, middle, pinky, ring, thumb, three joints each; then the tips in the same order.
MANO = [
    "wrist",
    "index1", "index2", "index3", "middle1", "middle2", "middle3", "pinky1", "pinky2", "pinky3",
    "ring1", "ring2", "ring3", "thumb1", "thumb2", "thumb3",
    "index_tip", "middle_tip", "pinky_tip", "ring_tip", "thumb_tip",
]  # fmt: skip
# OpenPose, manopth, H2O: wrist, thumb, index, middle, ring, pinky, each from the palm to its tip.
OPENPOSE_NAMES = [
    "wrist",
    "thumb1", "thumb2", "thumb3", "thumb_tip", "index1", "index2", "index3", "index_tip",
    "middle1", "middle2", "middle3", "middle_tip", "ring1", "ring2", "ring3", "ring_tip",
    "pinky1", "pinky2", "pinky3", "pinky_tip",
]  # fmt: skip


def numbered(names: list[str]) -> np.ndarray:
    """(2 frames, 21, 3): the coordinates of each joint are its index in MANO's list, for any order of ``names``."""
    one = np.array([[MANO.index(name), MANO.index(name) + 0.1, MANO.index(name) + 0.2] for name in names])
    return np.stack([one, one + 100])


def test_the_joint_order_is_manos_with_the_tips_at_the_end():
    assert list(JOINT_NAMES) == MANO


def test_openpose_order_goes_finger_by_finger_from_the_thumb():
    assert [MANO[index] for index in OPENPOSE] == OPENPOSE_NAMES
    np.testing.assert_array_equal(openpose_to_mano_order(numbered(OPENPOSE_NAMES)), numbered(MANO))
