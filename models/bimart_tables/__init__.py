"""BimArt's tables redone: its baselines and ablations as settings of the same two networks, CAMS-B, and Table 6."""
