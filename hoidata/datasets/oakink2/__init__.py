"""OakInk2 (Zhan et al. 2024)."""
