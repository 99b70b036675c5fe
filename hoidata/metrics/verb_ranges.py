"""Compares a generated motion with the training clips of its verb; which side of each object is up in them.

A few measures describe how the object moves (``hoidata.actions``), how fast the fastest joint is and how much touching
joints slip. No test clip and no trained evaluator is involved.
"""

from dataclasses import dataclass, replace

import numpy as np

from hoidata.actions.action import Actions, action_numbers, training_actions, usual_limits
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import FPS, SIDES, Clip, ObjectTrack
from hoidata.clips.slip import joint_slips_cm_s, touched_parts
from hoidata.contact.proximity import ProximityIndex
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints
from hoidata.refinement import carried_fraction
from hoidata.store.annotated import AnnotatedStore

JOINT_SPEED = "joint_m_s"
FASTER = 1.1  # than in any training clip
SLIP = "slip_cm_s"
LEAST_DEVIATION_CM_S = 0.05  # of slip, for recorded hands that never slip
MIN_LIFT_FRACTION = 0.5  # of the checked frames in the air, in which the hands must be able to carry the object
ACCEPTED = (2, 0.0)  # ranks that begin so need no further candidate
ALIKE_UPS = 0.85  # length of the mean of directions that are up, unit vectors; 1 if all are equal


@dataclass(frozen=True)
class VerbRanges:
    """Usual ranges of the training clips' measures, by verb."""

    actions: Actions
    threshold_m: float  # distance below which a joint touches
    hands: HandPair

    def numbers(self, clip: Clip, points: ObjectPoints) -> dict[str, float]:
        """Measures of a clip: those of its object (``hoidata.actions``), ``JOINT_SPEED`` of the fastest joint, and mean
        ``SLIP`` of touching joints.
        """
        index, touching, speeds = ProximityIndex(points), np.zeros((len(SIDES), clip.n_frames), bool), [0.0]
        slips = [np.zeros(0)]
        for side_index, side in enumerate(SIDES):
            track = clip.hands[side]
            if track.valid.any():
                joints_m = track_joints(track, self.hands[side])
                near = index.entries(joints_m, track.valid, clip.object, self.threshold_m)
                touching[side_index, near["frame"]] = True
                speeds.append(fastest_joint(joints_m, track.valid))
                part = points.part[near["point"]]
                touched = touched_parts(clip.n_frames, near["frame"], near["joint"], near["distance_m"], part)
                slips.append(joint_slips_cm_s(clip.object, joints_m, touched))
        hand_measures = {JOINT_SPEED: max(speeds), SLIP: _mean(np.concatenate(slips))}
        return action_numbers(clip.object, clip.gravity, touching) | hand_measures

    def is_other(self, verb: str | None, moved_as: str | None) -> bool:
        """Whether a motion has another verb than the requested one; False if either is not known."""
        return None not in (verb, moved_as) and verb in self.actions.centroids and moved_as != verb

    def rank(self, verb: str | None, clip: Clip, points: ObjectPoints) -> tuple[int, float, float]:
        """Rank of a candidate in rejection sampling; larger is better.

        Number of criteria met: the hands can carry the object, and the object moves as in clips of ``verb``. Then the
        largest violation of the verb's ranges, negative; that of a motion with another verb does not count, because
        nearly every such motion has one. Then the fraction of frames in the air in which the hands can carry.
        """
        numbers, carried = self.numbers(clip, points), carried_fraction(self.hands, clip)
        is_other = self.is_other(verb, self.actions.nearest_verb(numbers))
        violation = 0.0 if is_other else max(self.actions.violations(verb or "", numbers).values(), default=0.0)
        return int(carried >= MIN_LIFT_FRACTION) + (not is_other), -violation, carried


def training_ranges(store: AnnotatedStore) -> Actions:
    """Actions of the training clips; their usual ranges also bound joint speed and slip."""
    speeds, slips = [0.0], dict[str, list[dict[str, float]]]()
    for clip_id in store.ids("train"):
        clip = store.clip(clip_id)
        speeds += [fastest_joint(store.joints(clip_id, side), clip.hands[side].valid) for side in SIDES]
        if verb := store.verb(clip_id):
            slips.setdefault(verb, []).append({SLIP: _recorded_slip_cm_s(store, clip_id, clip.object)})
    all_slips = [measures[SLIP] for clips in slips.values() for measures in clips]
    scale = {SLIP: (0.0, max(float(np.std(all_slips)), LEAST_DEVIATION_CM_S))} if all_slips else {}
    most_slip = {verb: limits[SLIP][1] for verb, limits in usual_limits(slips, scale).items()}
    # A corpus whose hands never move bounds nothing.
    fastest = {JOINT_SPEED: (0.0, FASTER * max(speeds))} if max(speeds) else {}
    actions = training_actions(store)
    slip = {verb: {SLIP: (0.0, most_slip[verb])} if verb in most_slip else {} for verb in actions.centroids}
    return replace(actions, usual={verb: actions.usual.get(verb, {}) | fastest | slip[verb] for verb in slip})


def _recorded_slip_cm_s(store: AnnotatedStore, clip_id: str, track: ObjectTrack) -> float:
    """``SLIP`` of a recorded clip, from its stored distances."""
    part, slips = store.points(store.object_key(clip_id)).part, []
    for side in SIDES:
        near = store.distances(clip_id, side)
        touched = touched_parts(track.n_frames, near.frame, near.joint, near.distance_m, part[near.point])
        slips.append(joint_slips_cm_s(track, store.joints(clip_id, side), touched))
    return _mean(np.concatenate(slips))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else 0.0


def fastest_joint(joints_m: np.ndarray, valid: np.ndarray) -> float:
    """Speed in m/s of the fastest joint (F, 21, 3) between two frames that are ``valid`` (F,)."""
    steps = np.linalg.norm(np.diff(joints_m.astype(np.float64), axis=0), axis=2)[valid[1:] & valid[:-1]]
    return float(steps.max(initial=0.0)) * FPS


def object_ups(store: AnnotatedStore) -> dict[str, list[float]]:
    """(3,) direction that is up in the first frame, object frame, by object: the mean of its training clips.

    Objects that start in too different poses have none.
    """
    ups: dict[str, list[np.ndarray]] = {}
    for clip_id in store.ids("train"):
        clip = store.store.clip(clip_id, motion_only=True)
        if clip.gravity is not None:
            ups.setdefault(clip.object.model.name, []).append(up_in_object(clip.object, clip.gravity))
    means = {name: np.mean(directions, axis=0) for name, directions in sorted(ups.items())}
    return {
        name: np.round(mean / length, 4).tolist()
        for name, mean in means.items()
        if (length := np.linalg.norm(mean)) > ALIKE_UPS
    }


def up_in_object(track: ObjectTrack, gravity: np.ndarray) -> np.ndarray:
    """(3,) direction of the object that is up in the first frame, object frame."""
    return rotvec_to_rotmat(track.rotvec[0].astype(np.float64)).T @ -np.asarray(gravity, np.float64)
