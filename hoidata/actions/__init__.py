"""Measures of object motion, the limits that a verb sets on them, and their usual range in training clips."""
