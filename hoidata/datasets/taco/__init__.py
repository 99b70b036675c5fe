"""TACO: adapter and facts."""
