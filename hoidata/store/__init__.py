"""Store of clips in Parquet and NPZ files, and the annotated store built on it."""
