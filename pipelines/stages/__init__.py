"""The DVC stages, one module with a function ``run`` per stage."""
