"""Motions of an object without any recording: from keyframes, or from a short script; smooth, and checked."""

from hoidata.object_paths.keyframes import Keyframes, keyframed_path, parse_keyframes, read_keyframes
from hoidata.object_paths.path import ObjectPath, PathStep
from hoidata.object_paths.script import parse_script, scripted_path

__all__ = [
    "Keyframes",
    "ObjectPath",
    "PathStep",
    "keyframed_path",
    "parse_keyframes",
    "parse_script",
    "read_keyframes",
    "scripted_path",
]
