"""What every model family shares: features, transformer, sampling, training loop, checkpoints."""
