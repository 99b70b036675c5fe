"""Animated GLB files, pages that play them and the report: self-contained HTML, equal inputs give equal bytes."""
