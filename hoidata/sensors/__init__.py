"""Virtual sensors of a hand at an object (ManipNet): ambient, proximity, signed distance; of any hand, any object."""

from hoidata.sensors.sense import Sensed, sense, sensor_size
from hoidata.sensors.settings import OURS, PAPER, PRESETS, RELEASED, SensorSettings

__all__ = ["OURS", "PAPER", "PRESETS", "RELEASED", "Sensed", "SensorSettings", "sense", "sensor_size"]
