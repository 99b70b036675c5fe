"""BimArt (Zhang et al. 2024): two hands for any motion of an object with at most one hinge, by way of contact maps."""
