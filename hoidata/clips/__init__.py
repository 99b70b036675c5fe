"""Clips: motion of hands and objects, hand conventions, and the feature layout."""

from hoidata.clips.clip import (
    FPS,
    SIDES,
    BodyTrack,
    CameraTrack,
    Clip,
    HandTrack,
    HandType,
    ObjectTrack,
    Side,
    SourceContact,
    SourceFile,
    WorldFrame,
)

__all__ = [
    "FPS",
    "SIDES",
    "BodyTrack",
    "CameraTrack",
    "Clip",
    "HandTrack",
    "HandType",
    "ObjectTrack",
    "Side",
    "SourceContact",
    "SourceFile",
    "WorldFrame",
]
