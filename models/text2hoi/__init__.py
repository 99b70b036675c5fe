"""Text2HOI (Cha et al., CVPR 2024): contact, length, diffusion and refiner networks."""
