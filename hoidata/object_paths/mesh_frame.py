"""Generated clips in the frame of a user's mesh, which is z up and closed as in its file."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hoidata.clips.clip import Clip, Side
from hoidata.clips.features import upright
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index

Z = (0.0, 0.0, 1.0)


def training_from_z_up(object_ups: Mapping[str, Sequence[float]]) -> np.ndarray:
    """(3, 3) rotation of z to the axis that is up for most objects of the training clips.

    object_ups: by object, its direction (3,) that is up in training clips; the rotation is the identity if empty.
    """
    ups = np.asarray(list(object_ups.values()) or [Z])
    axes = [tuple(np.where(np.abs(up) == np.abs(up).max(), np.sign(up), 0.0)) for up in ups]
    # Entries are 0 and 1, so rotations are exact in float32.
    return np.rint(upright(-np.array(Counter(axes).most_common(1)[0][0]))).T.astype(np.float32)


def turned(model: ObjectModel, rotation: np.ndarray) -> ObjectModel:
    """The object in a frame that is rotated by ``rotation`` (3, 3)."""
    if (rotation == np.eye(3)).all():
        return model
    hinge = model.hinge and replace(
        model.hinge, axis=rotation @ model.hinge.axis, origin_m=rotation @ model.hinge.origin_m
    )
    return replace(model, vertices_m=model.vertices_m @ rotation.T, hinge=hinge)


def turned_back(clip: Clip, model: ObjectModel, rotation: np.ndarray) -> Clip:
    """The clip of an object that was ``turned``, with the object in the frame of its mesh."""
    rotvec = clip.object.rotvec
    if (rotation != np.eye(3)).any():
        rotvec = rotmat_to_rotvec(rotvec_to_rotmat(rotvec.astype(np.float64)) @ rotation).astype(np.float32)
    return replace(clip, object=replace(clip.object, model=model, rotvec=rotvec))


def closed_as_stored(clip: Clip, hands: HandPair) -> Clip:
    """The clip with the least hinge angle at 0, as the mesh is stored; hands on the moving part move with it."""
    hinge_rad = clip.object.hinge_rad
    return clip if hinge_rad is None else _joint_moved(clip, np.full(clip.n_frames, -hinge_rad.min()), hands)


def within_limits(clip: Clip, limits: tuple[float, float] | None, hands: HandPair) -> Clip:
    """The clip with joint positions, radians or metres, cut at the limits; hands on the moving part move with it."""
    hinge_rad = clip.object.hinge_rad
    if hinge_rad is None or limits is None or (limits[0] <= hinge_rad.min() and hinge_rad.max() <= limits[1]):
        return clip
    return _joint_moved(clip, np.clip(hinge_rad, *limits) - hinge_rad, hands)


def opening_upwards(
    model: ObjectModel, limits: tuple[float, float] | None
) -> tuple[ObjectModel, tuple[float, float] | None]:
    """The object and its joint limits with the axis turned round if most of the range is negative.

    In most training clips, positions grow as an object opens.
    """
    if model.hinge is None or limits is None or -limits[0] <= limits[1]:
        return model, limits
    return replace(model, hinge=replace(model.hinge, axis=-model.hinge.axis)), (-limits[1], -limits[0])


def axis_turned_back(clip: Clip, model: ObjectModel) -> Clip:
    """The clip with the object ``model``, whose joint has the opposite axis."""
    assert clip.object.hinge_rad is not None
    return replace(clip, object=replace(clip.object, model=model, hinge_rad=0.0 - clip.object.hinge_rad))


def _joint_moved(clip: Clip, change_rad: np.ndarray, hands: HandPair) -> Clip:
    """The clip with joint positions changed by ``change_rad`` (frame,); hands on the moving part move with it."""
    track, tracks = clip.object, dict(clip.hands)
    if track.hinge_rad is None or track.model.hinge is None:
        return clip
    world_from_object = track.world_from_object
    moved = world_from_object @ track.model.hinge.turn(change_rad) @ world_from_object.inverse()
    for side, hand in clip.hands.items():
        if hand.valid.any() and _nearest_part(clip, side, hands) == 1:
            wrist_m = (moved @ hand.wrist_m[:, None].astype(np.float64))[:, 0].astype(np.float32)
            rotation = moved.rotation @ rotvec_to_rotmat(hand.global_orient.astype(np.float64))
            tracks[side] = replace(hand, wrist_m=wrist_m, global_orient=rotmat_to_rotvec(rotation).astype(np.float32))
    return replace(clip, hands=tracks, object=replace(track, hinge_rad=track.hinge_rad + change_rad))


def _nearest_part(clip: Clip, side: Side, hands: HandPair) -> int:
    """The part of the object that is closer to the joints of a hand, on average over all frames."""
    track = clip.object
    joints_m = track.world_from_object.inverse() @ track_joints(clip.hands[side], hands[side]).astype(np.float64)

    def distance_m(part: int) -> float:
        in_part_m = track.model.object_from_part(part, track.hinge_rad).inverse() @ joints_m
        surface = surface_index(track.model).filled[part]
        distances_m = surface.distance_m(np.ascontiguousarray(in_part_m.reshape(-1, 3))).reshape(joints_m.shape[:2])
        return float(distances_m.min(axis=1).mean())

    return min(track.model.parts, key=distance_m)
