"""What the sensors of a hand say about an object: 1,822 numbers per hand and frame for ManipNet's hand."""

from typing import NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors.settings import CELLS, OURS, SensorSettings


class Sensed(NamedTuple):
    """Metres and canonical axes; equal for a right hand and the left hand that is its mirror image.

    ambient: (frame, 1000) occupancy 0 to 1 of cells, index ``100 x + 10 y + z``. proximity_m: (frame, time, sensor).
    distance_m: (frame, time, point) signed, of joints and tips. normal: (frame, point, 3) gradient of the distance now.
    """

    ambient: np.ndarray
    proximity_m: np.ndarray
    distance_m: np.ndarray
    normal: np.ndarray

    def flat(self) -> np.ndarray:
        """(frame, value) in this order: 1000 + times x sensors + times x points + 3 x points."""
        return np.concatenate([array.reshape(len(array), -1) for array in self], axis=1)


def sensor_size(hand: TrackedHand, settings: SensorSettings = OURS) -> int:
    """How many numbers ``Sensed.flat`` has per frame."""
    return CELLS**3 + len(settings.times_s) * (hand.n_sensors + hand.n_points) + 3 * hand.n_points


def sense(
    hand: TrackedHand,
    state: HandState,
    object_from_wrist: RigidTransform,
    hinge_rad: np.ndarray | None,
    surface: SurfaceIndex,
    settings: SensorSettings = OURS,
) -> Sensed:
    """The sensors of a hand at an object, now and while the hand as it is now is carried by its wrist.

    state: the hand in its wrist's frame (``hand.state(...)``), (frame,). object_from_wrist: (frame, time) transforms at
    the times of ``settings.times_s``, the first now. hinge_rad: (frame, time) of a hinged object, else None.
    surface: of the object (``hoidata.objects.surface_index.surface_index(model)``).
    """
    raise NotImplementedError
