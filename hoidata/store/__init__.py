"""The Parquet + NPZ store of clips, and the annotated store over it."""
