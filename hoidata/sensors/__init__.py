"""Virtual sensors of a hand at an object (ManipNet), and BimArt's basis point sets and hand keypoints."""

from hoidata.sensors.sense import SensorReadings, sense, sensor_size
from hoidata.sensors.settings import OURS, PAPER, SensorSettings

__all__ = ["OURS", "PAPER", "SensorReadings", "SensorSettings", "sense", "sensor_size"]
