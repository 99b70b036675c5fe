"""Exact contact of a hand with an object's surface: touched vertices, penetration depth, overlap, BimArt's maps."""
