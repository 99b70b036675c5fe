"""ManipNet (Zhang et al. 2021): fingers of both hands from the trajectories of wrists and objects."""
