"""Virtual sensors of a hand at an object (ManipNet), and BimArt's basis point sets and hand keypoints."""

from hoidata.sensors.sense import OURS, PAPER, SensorReadings, SensorSettings, sense, sensor_size

__all__ = ["OURS", "PAPER", "SensorReadings", "SensorSettings", "sense", "sensor_size"]
