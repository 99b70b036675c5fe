"""Canonical objects: meshes, parts and hinges, sampled points, signed distance."""

from hoidata.objects.model import Hinge, ObjectModel, articulate

__all__ = ["Hinge", "ObjectModel", "articulate"]
