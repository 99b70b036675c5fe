"""What a clip is, and how clips are stored."""

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
