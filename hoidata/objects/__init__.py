"""Canonical objects: meshes, parts and hinges, sampled points, signed distance."""

from hoidata.objects.model import Hinge, ObjectModel, articulate, place

__all__ = ["Hinge", "ObjectModel", "articulate", "place"]
