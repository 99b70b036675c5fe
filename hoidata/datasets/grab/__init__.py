"""GRAB: adapter and facts."""
