"""Object motions from keyframes: interpolated smoothly, and checked against the limits of a hand."""

from hoidata.object_paths.keyframes import Keyframes, keyframed_path, parse_keyframes, read_keyframes
from hoidata.object_paths.path import ObjectPath, PathStep

__all__ = ["Keyframes", "ObjectPath", "PathStep", "keyframed_path", "parse_keyframes", "read_keyframes"]
