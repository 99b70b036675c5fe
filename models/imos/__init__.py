"""IMoS (Ghosh et al. 2023), adapted to two hands and an object."""
