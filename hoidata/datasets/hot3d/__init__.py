"""HOT3D: adapter and facts."""
