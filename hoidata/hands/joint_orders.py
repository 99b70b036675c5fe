"""OpenPose's joint order, also used by manopth and H2O, and the way from it to ours.

Ours (see ``JOINT_NAMES``): MANO's 16 joints (wrist, index, middle, pinky, ring, thumb), then the tips in that order.
OpenPose's: wrist, then thumb, index, middle, ring, pinky, each from its base to its tip.
"""

import numpy as np

# Place in our order of each of OpenPose's 21 joints.
OPENPOSE = (0, 13, 14, 15, 20, 1, 2, 3, 16, 4, 5, 6, 17, 10, 11, 12, 19, 7, 8, 9, 18)


def openpose_to_mano_order(joints: np.ndarray) -> np.ndarray:
    """Joints (..., 21, 3) given in OpenPose's order, in ours."""
    return joints[..., np.argsort(OPENPOSE), :]
