"""Things to look at: animated GLB files, pages that play them, the report. Self-contained, the same bytes each time."""
