"""How the embedded hand was built from CC0 assets; no stage runs it."""
