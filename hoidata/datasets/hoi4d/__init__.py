"""HOI4D (Liu et al. 2022)."""
