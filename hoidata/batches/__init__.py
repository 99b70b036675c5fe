"""Clips as training samples and padded batches, and requests for motions."""
