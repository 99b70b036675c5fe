"""Data of 3D hand-object interaction: raw datasets to one schema, with words, contact, splits and measures."""
