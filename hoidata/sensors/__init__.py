"""Virtual sensors of a hand at an object (ManipNet): ambient, proximity, signed distance; of any hand, any object."""

from hoidata.sensors.sense import Sensed, sense, sensor_size
from hoidata.sensors.settings import OURS, PAPER, SensorSettings

__all__ = ["OURS", "PAPER", "Sensed", "SensorSettings", "sense", "sensor_size"]
