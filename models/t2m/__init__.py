"""T2M (Guo et al. 2022), adapted to two hands and an object."""
