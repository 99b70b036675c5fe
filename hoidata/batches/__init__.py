"""Clips as training sees them: samples, batches and the torch dataset."""
