"""Data of 3D hand-object interaction: raw datasets in one schema, with sentences, contact, splits and metrics."""
