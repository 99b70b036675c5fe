"""ARCTIC: adapter and facts."""
