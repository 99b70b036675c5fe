"""The joint orders and fingertip vertices of the libraries whose data we read, and the way between them.

Ours (see ``JOINT_NAMES``): MANO's 16 joints (wrist, index, middle, pinky, ring, thumb), then the tips in that order.
OpenPose's, also used by manopth and H2O: wrist, then thumb, index, middle, ring, pinky, each from its base to its tip.
"""

from typing import Literal

import numpy as np

Order = Literal["mano", "openpose"]

# Place in our order of each of OpenPose's 21 joints.
OPENPOSE = (0, 13, 14, 15, 20, 1, 2, 3, 16, 4, 5, 6, 17, 10, 11, 12, 19, 7, 8, 9, 18)
# Vertices of MANO's mesh taken for the tips of index, middle, pinky, ring and thumb.
TIP_SETS: dict[str, tuple[int, ...]] = {
    "text2hoi": (317, 445, 673, 556, 745),
    "manopth right": (317, 444, 673, 556, 745),
    "manopth left": (317, 445, 673, 556, 745),
    "smplx": (320, 443, 671, 554, 744),
}


def to_mano_order(joints: np.ndarray, order: Order) -> np.ndarray:
    """Joints (..., 21, 3) given in another order, in ours."""
    return joints if order == "mano" else joints[..., np.argsort(OPENPOSE), :]


def from_mano_order(joints: np.ndarray, order: Order) -> np.ndarray:
    """Joints (..., 21, 3) of our order in another one; the inverse of ``to_mano_order``."""
    return joints if order == "mano" else joints[..., OPENPOSE, :]
