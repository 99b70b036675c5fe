"""ManipNet: adapter and facts."""
