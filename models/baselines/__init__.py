"""What a model has to beat: the truth above it, and simple rivals that need no training."""
