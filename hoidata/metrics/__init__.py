"""Metrics that compare predicted clips with the recorded clips, and the registry that lists them."""
