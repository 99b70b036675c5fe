"""What a clip is, and how clips are stored."""

from hoidata.schema.clip import FPS, SIDES, Clip, HandTrack, HandType, ObjectTrack, Side, SourceFile

__all__ = ["FPS", "SIDES", "Clip", "HandTrack", "HandType", "ObjectTrack", "Side", "SourceFile"]
