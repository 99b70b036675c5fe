"""Canonical objects: meshes, parts and hinges, sampled points, signed distance."""
