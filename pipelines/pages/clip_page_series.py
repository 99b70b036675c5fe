"""What one clip's page plots, frame by frame: touched points, nearest distance, penetration, and how the object moves.

Contact with points and hand types are read from the folders of the stages; the exact surface is asked here.
"""

from dataclasses import dataclass

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.contact.maps import LONGEST_CLIP
from hoidata.hands import HandPair
from hoidata.objects.surface_index import surface_index
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.hand_evidence import HandEvidence
from hoidata.surface.measure import SideSurface, measure_hand


@dataclass(frozen=True)
class ClipSeries:
    """Everything per frame (frame,), NaN where it means nothing.

    touched: per side (frame, point) bool, the contact map of each frame. evidence: what the hand type rests on.
    surface: per side the hand against the exact surface. solid: whether anything can be inside the object, so that
    depths mean something.
    lift_m: height of the object above its first frame, or None without gravity. hinge_rad: None for a rigid object.
    """

    touched: dict[Side, np.ndarray]
    evidence: HandEvidence
    surface: dict[Side, SideSurface]
    solid: bool
    speed_m_s: np.ndarray
    lift_m: np.ndarray | None
    hinge_rad: np.ndarray | None

    def touched_count(self, side: Side) -> np.ndarray:
        """(frame,) how many of the sampled points this hand touches."""
        return self.touched[side].sum(axis=1)

    @property
    def depth_m(self) -> dict[Side, np.ndarray] | None:
        """Per side the deepest hand vertex inside the object, or None where the mesh has no inside."""
        return {side: found.depth_m for side, found in self.surface.items()} if self.solid else None

    @property
    def surface_evidence(self) -> HandEvidence:
        """The hand test against the exact surface in place of sampled points, at the same threshold."""
        distance: dict[Side, np.ndarray] = {side: found.joint_m for side, found in self.surface.items()}
        return HandEvidence(None, distance, self.evidence.threshold_m).at_threshold(self.evidence.threshold_m)


def measure_clip(annotated: AnnotatedStore, clip: Clip, hands: HandPair) -> ClipSeries:
    """The series of one clip of an annotated dataset; hands: the model of its store."""
    points = annotated.points(annotated.object_key(clip.clip_id))
    # The mean of the sampled points: the moving part counts as far as its surface goes.
    centre_m = clip.object.points_in_world(points.points_m, points.part).mean(axis=1)
    return ClipSeries(
        touched={side: _touched(annotated, clip, side, len(points)) for side in SIDES},
        evidence=annotated.hand_evidence(clip.clip_id),
        surface={side: measure_hand(clip, side, hands, points) for side in SIDES},
        solid=surface_index(clip.object.model).is_solid,
        speed_m_s=_speed_m_s(centre_m),
        lift_m=None if clip.gravity is None else -(centre_m - centre_m[0]) @ np.asarray(clip.gravity, np.float64),
        hinge_rad=clip.object.hinge_rad,
    )


def _touched(annotated: AnnotatedStore, clip: Clip, side: Side, n_points: int) -> np.ndarray:
    """(frame, point) bool: a joint of the hand is within the contact stage's threshold of the point."""
    assert clip.n_frames <= LONGEST_CLIP
    entries = annotated.distances(clip.clip_id, side)
    touched = np.zeros((clip.n_frames, n_points), dtype=bool)
    touched[entries.frame, entries.point] = True
    return touched


def _speed_m_s(centre_m: np.ndarray) -> np.ndarray:
    """(frame,) central differences; 0 for a single frame."""
    if len(centre_m) < 2:
        return np.zeros(len(centre_m))
    return np.linalg.norm(np.gradient(centre_m, axis=0), axis=1) * FPS
