"""Whether an adapter keeps the rules, tried on raw files: for built-in adapters and those of others."""
