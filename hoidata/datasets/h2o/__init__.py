"""H2O: adapter and facts."""
