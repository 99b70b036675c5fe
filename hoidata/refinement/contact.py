"""Contact refinement: a smooth correction that moves hands out of the object and onto its surface.

A hand is corrected in the frame of the part that it touches most. The correction is constant in a grasp, so wrist and
fingers keep their motion there, and smooth around it. Touching skin is pulled to the surface and skin inside of the
object is pushed out (``grasp_solver``). ``carried_fraction`` tells whether hands can carry the object.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.geometry.intervals import Interval, runs
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.model import HandPair
from hoidata.objects.surface_index import surface_index
from hoidata.physics.capsules import CapsuleContacts, Capsules, joined
from hoidata.physics.realism import StandardUnits
from hoidata.physics.scene import capsules_or_nan, object_scene
from hoidata.refinement.grasp_solver import corrected_pose
from hoidata.refinement.object_field import ObjectField, world_from_part
from hoidata.refinement.skin import HandPose, SkinnedHand
from hoidata.workers import one_thread

NEAR_M = 0.006  # a hand touches if its skin is closer than this
STILL_M_S = 0.02  # a touching hand slower than this on a part at rest grasps it
CARRIED_M_S = 0.3  # the same on a moving part
MOVING_M_S = 0.02  # a part faster than this moves
MIN_FRAMES = 6  # of a grasp
GAP_FRAMES = 12  # two grasps with at most so many frames between them are one
SAME_M = 0.08  # if the hand moved less than this on the part between them
AIR_FRAMES = 4  # frames with the object in the air in which ``carried_fraction`` checks the hands
PASSING_RAD = 0.05  # a lid that opens by this much moves past a hand on the base
_OPPOSITE: Mapping[Side, Side] = {"left": "right", "right": "left"}
_ALONG = 9  # points along a capsule's axis at which the distance is evaluated
_LEAST_SLOPE = 1e-6  # shorter gradients have no direction


@one_thread()
def refine_grasps(pair: HandPair, clip: Clip) -> Clip:
    """Refine the hands of a clip one after the other; hands without a grasp and invalid frames are unchanged."""
    tracks = dict(clip.hands)
    for side in SIDES:
        opposite = _OPPOSITE[side]
        has_other = tracks[opposite].valid.any()
        other = capsules_or_nan(tracks[opposite], pair[opposite]) if has_other else None
        tracks[side] = _refined(pair, clip, side, other)
    return replace(clip, hands=tracks)


def _refined(pair: HandPair, clip: Clip, side: Side, other: Capsules | None) -> HandTrack:
    """One hand after refinement. other: capsules of the other hand, world frame."""
    track, target = clip.hands[side], clip.object
    if not track.valid.any():
        return track
    skin = SkinnedHand(pair[side], np.asarray(track.betas, np.float64)[0], track.template_m)
    pose, field = HandPose.of(track), ObjectField(target)
    points_m = skin.vertices_m(skin.chain(pose))
    touching: np.ndarray = (field.distances(points_m)[0] < NEAR_M) & track.valid[:, None]
    part, touching = field.part_touched(points_m, touching)
    world_from_grasped = world_from_part(target, part)
    grasps = _grasps(points_m, np.any(touching, axis=1), world_from_grasped, track.valid)
    if not grasps:
        return track
    part_from_world = world_from_grasped.inverse()
    corrected = corrected_pose(
        skin,
        ObjectField(_in_part(target, target.model.object_from_part(part, target.hinge_rad))),
        pose.relative_to(part_from_world),
        grasps,
        track.valid,
        None if other is None else other.relative_to(part_from_world),
        part=part,
        passed=_passed(target, grasps),
    )
    refined = corrected.relative_to(world_from_grasped).track(track.mean_betas, track.valid, track.template_m)
    arrays = {
        name: (getattr(refined, name), getattr(track, name)) for name in ("wrist_m", "global_orient", "hand_pose")
    }
    return replace(track, **{name: np.where(track.valid[:, None], *pair) for name, pair in arrays.items()})


def _passed(target: ObjectTrack, grasps: Sequence[Interval]) -> np.ndarray | None:
    """(frame,) bool: grasps in which one part of an object moves past the other; None where there are none."""
    hinge_rad, passed = target.joint_angle_rad, np.zeros(target.n_frames, bool)
    for start, stop in grasps:
        passed[start:stop] = hinge_rad is not None and np.ptp(hinge_rad[start:stop]) > PASSING_RAD
    return passed if passed.any() else None


def _in_part(target: ObjectTrack, object_from_part: RigidTransform) -> ObjectTrack:
    """The object's motion as the part sees it."""
    back = object_from_part.inverse()
    rotation, translation = (
        np.broadcast_to(array, (target.n_frames, *array.shape[back.rotation.ndim - 2 :]))
        for array in (back.rotation, back.translation)
    )
    return replace(target, rotvec=rotmat_to_rotvec(rotation), translation_m=translation)


def _grasps(
    points_m: np.ndarray, touching: np.ndarray, world_from_part: RigidTransform, valid: np.ndarray
) -> list[Interval]:
    """Intervals in which a hand, vertices (frame, vertex, 3) world, touches (frame,) a part and hardly moves on it."""
    sampled_m = world_from_part.inverse() @ points_m[:, ::20]
    speed = np.linalg.norm(np.diff(sampled_m, axis=0), axis=-1).mean(axis=1) * FPS
    carried = world_from_part[1:] @ sampled_m[:-1] - world_from_part[:-1] @ sampled_m[:-1]
    moving = np.linalg.norm(carried, axis=-1).mean(axis=1) * FPS > MOVING_M_S
    slow = speed < np.where(moving, CARRIED_M_S, STILL_M_S)
    is_grasp = touching & (np.append(slow, False) | np.append(False, slow))
    for start, stop in runs(~is_grasp):
        short = start > 0 and stop < len(is_grasp) and stop - start <= GAP_FRAMES and valid[start:stop].all()
        if short and np.linalg.norm(sampled_m[stop] - sampled_m[start - 1], axis=-1).mean() < SAME_M:
            is_grasp[start:stop] = True
    return [grasp for grasp in runs(is_grasp) if grasp.stop - grasp.start >= MIN_FRAMES]


@one_thread()
def carried_fraction(pair: HandPair, clip: Clip) -> float:
    """Fraction of some frames with the object in the air in which the hands can carry it; 1 without such frames.

    Hands carry an object if friction at their contacts can produce its motion. An object without known gravity or
    without an inside counts as carried.
    """
    if clip.gravity is None or clip.n_frames < 3 or not surface_index(clip.object.model).is_solid:
        return 1.0
    scene = object_scene(clip)
    in_air = np.flatnonzero(scene.lifted)
    if not len(in_air):
        return 1.0
    frames = in_air[((np.arange(AIR_FRAMES) + 0.5) * len(in_air) / AIR_FRAMES).astype(int)]
    tracks: dict[Side, HandTrack] = {
        side: clip.hands[side].take(frames) for side in SIDES if clip.hands[side].valid.any()
    }
    if not tracks:
        return 0.0
    capsules = joined([capsules_or_nan(track, pair[side]) for side, track in tracks.items()])
    contacts, physics = field_contacts(ObjectField(clip.object), capsules, frames), StandardUnits()
    return float((physics.residuals(scene, contacts)[frames] < physics.limit).mean())


def field_contacts(field: ObjectField, capsules: Capsules, frames: np.ndarray) -> CapsuleContacts:
    """Contacts of capsules with an object in ``frames (frame,)``, at the deepest of some points along each axis.

    Read from the distance grid; ``hoidata.physics.capsules.capsule_contacts`` is exact and far slower.
    """
    is_known = np.isfinite(capsules.start_m[..., 0])
    capsules = Capsules(np.nan_to_num(capsules.start_m), np.nan_to_num(capsules.end_m), capsules.radius_m)
    along = np.linspace(0, 1, _ALONG)[:, None]
    axis = (capsules.end_m - capsules.start_m)[:, :, None]
    positions_m = (capsules.start_m[:, :, None] + along * axis).reshape(len(frames), -1, 3)
    nearest = field.distances(positions_m, frames)
    shape = (*capsules.start_m.shape[:2], _ALONG)
    distance, slope, position_m = (array.reshape(*shape, -1) for array in (*nearest, positions_m))
    deepest = distance.argmin(axis=2, keepdims=True)
    distance, slope, position_m = (np.take_along_axis(a, deepest, 2)[:, :, 0] for a in (distance, slope, position_m))
    # Interpolated gradients are shorter than one at edges, and zero in the middle of a thin object.
    length = np.linalg.norm(slope, axis=-1)
    slope /= np.maximum(length, _LEAST_SLOPE)[..., None]
    frame, capsule = np.nonzero(is_known & (distance[..., 0] < capsules.radius_m) & (length > _LEAST_SLOPE))
    depth, normal = (capsules.radius_m - distance[..., 0])[frame, capsule], slope[frame, capsule]
    point = (position_m - distance * slope)[frame, capsule]
    number = frames[frame]
    return CapsuleContacts(number, capsule, np.zeros_like(number), depth, point, normal, point, normal)
