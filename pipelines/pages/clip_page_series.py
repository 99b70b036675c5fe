"""What one clip's page plots, frame by frame: touched points, nearest distance, penetration, and how the object moves.

Numbers of the stages are read where they are stored; the distances of the hand test and the penetration, of which the
stages keep only the extremes, are measured again with the functions of those stages.
"""

from dataclasses import dataclass

import numpy as np

from hoidata.contact import HandEvidence, ProximityIndex, acting_hands
from hoidata.contact.maps import LONGEST_CLIP
from hoidata.hands import HandPair, track_vertices
from hoidata.objects.sampling import sample_points
from hoidata.quality.measures import ObjectFacts, placed
from hoidata.quality.penetration import depths_m, object_frame
from hoidata.schema.annotated import AnnotatedStore
from hoidata.schema.clip import FPS, SIDES, Clip, Side


@dataclass(frozen=True)
class ClipSeries:
    """Everything per frame (frame,), NaN where it means nothing.

    touched: per side (frame, point) bool, the contact map of each frame. evidence: what the hand type rests on.
    depth_m: per side the deepest hand vertex inside the object, or None where the mesh has no inside.
    lift_m: height of the object above its first frame, or None without gravity. hinge_rad: None for a rigid object.
    """

    touched: dict[Side, np.ndarray]
    evidence: HandEvidence
    depth_m: dict[Side, np.ndarray] | None
    speed_m_s: np.ndarray
    lift_m: np.ndarray | None
    hinge_rad: np.ndarray | None

    def touched_count(self, side: Side) -> np.ndarray:
        """(frame,) how many of the sampled points this hand touches."""
        return self.touched[side].sum(axis=1)


def measure_clip(annotated: AnnotatedStore, clip: Clip, hands: HandPair) -> ClipSeries:
    """The series of one clip of an annotated dataset; hands: the model of its store."""
    centre_m = _centre_m(annotated, clip)
    return ClipSeries(
        touched={side: _touched(annotated, clip, side) for side in SIDES},
        evidence=_evidence(annotated, clip),
        depth_m=_depths(clip, hands),
        speed_m_s=_speed_m_s(centre_m),
        lift_m=None if clip.gravity is None else -(centre_m - centre_m[0]) @ np.asarray(clip.gravity, np.float64),
        hinge_rad=clip.object.hinge_rad,
    )


def _touched(annotated: AnnotatedStore, clip: Clip, side: Side) -> np.ndarray:
    """(frame, point) bool: a joint of the hand is within the contact stage's threshold of the point."""
    assert clip.n_frames <= LONGEST_CLIP
    entries = annotated.distances(clip.clip_id, side)
    touched = np.zeros((clip.n_frames, len(annotated.points(annotated.object_key(clip.clip_id)))), dtype=bool)
    touched[entries.frame, entries.point] = True
    return touched


def _evidence(annotated: AnnotatedStore, clip: Clip) -> HandEvidence:
    """The hand test of the stage annotate, with its number of points and its threshold."""
    info = annotated.annotation_info
    index = ProximityIndex(sample_points(clip.object.model, info["points"]))
    joints: dict[Side, np.ndarray] = {side: annotated.joints(clip.clip_id, side) for side in SIDES}
    return acting_hands(clip, joints, index, info["threshold_m"])


def _depths(clip: Clip, hands: HandPair) -> dict[Side, np.ndarray] | None:
    """Per side the deepest vertex inside the solid parts of the object in every frame, metres."""
    parts = ObjectFacts.of(clip.object.model).solid_parts
    return {side: _depth_m(clip, hands, side, parts) for side in SIDES} if parts else None


def _depth_m(clip: Clip, hands: HandPair, side: Side, parts: list[int]) -> np.ndarray:
    track = clip.hands[side]
    if not track.valid.any():
        return np.full(clip.n_frames, np.nan)
    local = object_frame(track_vertices(track, hands[side]), clip.object.rotvec, clip.object.translation_m)
    return np.where(track.valid, depths_m(clip.object.model, clip.object.hinge_rad, local, parts), np.nan)


def _centre_m(annotated: AnnotatedStore, clip: Clip) -> np.ndarray:
    """(frame, 3) mean of the sampled points in the world: the moving part counts as far as its surface goes."""
    points = annotated.points(annotated.object_key(clip.clip_id))
    return placed(clip.object, points.points_m, points.part).mean(axis=1)


def _speed_m_s(centre_m: np.ndarray) -> np.ndarray:
    """(frame,) central differences; 0 for a single frame."""
    if len(centre_m) < 2:
        return np.zeros(len(centre_m))
    return np.linalg.norm(np.gradient(centre_m, axis=0), axis=1) * FPS
