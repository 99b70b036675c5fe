"""Exact contact of hand and object surface: touched vertices, depth, shared volume, BimArt's maps."""
