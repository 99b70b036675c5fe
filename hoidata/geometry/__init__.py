"""Rotations and rigid motion as pure functions."""
