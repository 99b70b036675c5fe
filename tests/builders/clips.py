"""Clips of tests, and the same clip changed: a hand or an object, another world, a mirror."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, Clip, HandTrack, HandType, ObjectTrack, Side
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.objects.model import Hinge, ObjectModel
from tests.builders.objects import box_model, hinged_box

TOP_M, TIP_GAP_M = 0.03, 0.003
DOWN = np.array([0.0, 0.0, -1.0])
MIRROR = np.array([-1.0, 1.0, 1.0])


def random_hand(n_frames: int, seed: int = 0, betas_rows: int = 1, template_m: np.ndarray | None = None) -> HandTrack:
    """Numbers of a hand, float64: half a metre about the origin, any orientation, fingers bent by half a radian."""
    random = np.random.default_rng(seed)
    return HandTrack(
        wrist_m=random.normal(0, 0.5, (n_frames, 3)),
        global_orient=random.normal(0, 1.5, (n_frames, 3)),
        hand_pose=random.normal(0, 0.5, (n_frames, 45)),
        betas=random.normal(0, 1, (betas_rows, 10)),
        valid=np.ones(n_frames, dtype=bool),
        template_m=template_m,
    )


def flat_hand(wrist_m: np.ndarray, valid: np.ndarray | None = None) -> HandTrack:
    """A hand in its rest pose and shape at (frame, 3) positions."""
    wrist = np.asarray(wrist_m, np.float32)
    zeros, pose = np.zeros_like(wrist), np.zeros((len(wrist), 45), np.float32)
    valid = np.ones(len(wrist), bool) if valid is None else valid
    betas = np.zeros((1, 10), np.float32)
    return HandTrack(wrist_m=wrist, global_orient=zeros, hand_pose=pose, betas=betas, valid=valid)


def still_object(model: ObjectModel, n_frames: int, hinge_rad: np.ndarray | None = None) -> ObjectTrack:
    still = np.zeros((n_frames, 3), np.float32)
    return ObjectTrack(model, still, still, hinge_rad)


def clip_of(clip_id: str, track: ObjectTrack, hands: dict[Side, HandTrack] | None = None, **facts: Any) -> Clip:
    """A synthetic clip named dataset/subject/sequence; the hands are at the origin by default."""
    dataset, subject, *_ = clip_id.split("/")
    clip = Clip(
        clip_id=clip_id,
        dataset=dataset,
        subject=subject,
        sequence=clip_id.partition("/")[2],
        hands=hands or {side: flat_hand(np.zeros((track.n_frames, 3))) for side in SIDES},
        object=track,
        source_frames=np.arange(track.n_frames, dtype=np.int32),
        gravity=DOWN,
        verb="lift",
        object_words=track.model.name,
        synthetic=True,
    )
    return replace(clip, **facts)


def build_clip(
    n_frames: int = 30,
    hand_type: HandType = "right",
    articulated: bool = False,
    seed: int = 0,
    clip_id: str = "test/s1/box_lift_1",
    subject: str = "s1",
    verb: str | None = "lift",
    gravity: tuple[float, float, float] | None = (0.0, 0.0, -1.0),
) -> Clip:
    """A small valid clip of an embedded hand that grasps a box.

    The box moves along a smooth random path. An active hand moves with it, its middle fingertip 3 mm above a face. An
    inactive hand is valid, but half a metre away.
    """
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, n_frames)[:, None]
    rotation = rotvec_to_rotmat(rng.normal(0, 0.5, 3) + np.sin(time) * rng.normal(0, 0.5, 3))
    translation = np.array([0.1, 0.2, 0.8]) + time * rng.normal(0, 0.2, 3)
    hands = {side: _hand(side, hand_type in (side, "both"), rotation, translation, rng) for side in SIDES}
    track = ObjectTrack(
        hinged_box() if articulated else box_model(),
        rotmat_to_rotvec(rotation).astype(np.float32),
        translation.astype(np.float32),
        (0.4 * time[:, 0]).astype(np.float32) if articulated else None,
    )
    gravity_direction = None if gravity is None else np.array(gravity)
    return clip_of(
        clip_id,
        track,
        hands,
        subject=subject,
        verb=verb,
        gravity=gravity_direction,
        object_words="box",
        synthetic=False,
    )


def _hand(
    side: Side, is_active: bool, rotation: np.ndarray, translation: np.ndarray, rng: np.random.Generator
) -> HandTrack:
    pose, betas = rng.normal(0, 0.1, 45), rng.normal(0, 0.5, (1, 10))
    orient = Rotation.from_euler("y", 90 if side == "left" else -90, degrees=True).as_matrix()
    from_wrist = _middle_tip(side, orient, pose, betas)
    face = np.array([0.0, 0.0, TOP_M + TIP_GAP_M]) if is_active else np.array([0.5, 0.0, 0.5])
    # Each hand is above one half of the top face.
    face[1] += 0.02 if side == "left" else -0.02
    return HandTrack(
        wrist_m=(rotation @ (face - from_wrist) + translation).astype(np.float32),
        global_orient=rotmat_to_rotvec(rotation @ orient).astype(np.float32),
        hand_pose=np.repeat(pose[None], len(rotation), axis=0).astype(np.float32),
        betas=betas.astype(np.float32),
        valid=np.ones(len(rotation), dtype=bool),
    )


def _middle_tip(side: Side, orient: np.ndarray, pose: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """Return (3,) from the wrist to the tip of the middle finger."""
    at_origin = HandTrack(
        wrist_m=np.zeros((1, 3)),
        global_orient=rotmat_to_rotvec(orient)[None],
        hand_pose=pose[None],
        betas=betas,
        valid=np.ones(1, dtype=bool),
    )
    return track_joints(at_origin, load_embedded_hands()[side])[0, 17]


def with_hand(clip: Clip, side: Side = "right", **changes: Any) -> Clip:
    return replace(clip, hands={**clip.hands, side: replace(clip.hands[side], **changes)})


def with_object(clip: Clip, **changes: Any) -> Clip:
    return replace(clip, object=replace(clip.object, **changes))


def jumping(clip: Clip, frame: int, metres: float) -> Clip:
    """Shift the object along each axis, from one frame on."""
    translation_m = clip.object.translation_m.copy()
    translation_m[frame:] += metres
    return with_object(clip, translation_m=translation_m)


def in_another_world(clip: Clip, rotation: Rotation, shift_m: np.ndarray) -> Clip:
    """The clip in a world with points ``rotation(p) + shift_m``, by SciPy's formulas, in the clip's dtypes."""

    def moved(points_m: np.ndarray) -> np.ndarray:
        return (rotation.apply(points_m) + shift_m).astype(points_m.dtype)

    def turned(rotvec: np.ndarray) -> np.ndarray:
        return (rotation * Rotation.from_rotvec(rotvec)).as_rotvec().astype(rotvec.dtype)

    def track(old: ObjectTrack) -> ObjectTrack:
        return replace(old, rotvec=turned(old.rotvec), translation_m=moved(old.translation_m))

    back = np.eye(4)
    back[:3, :3], back[:3, 3] = rotation.inv().as_matrix(), -rotation.inv().apply(shift_m)
    camera = clip.camera
    if camera is not None:
        camera = replace(camera, rotvec=turned(camera.rotvec), position_m=moved(camera.position_m))
    hands = {
        side: replace(hand, wrist_m=moved(hand.wrist_m), global_orient=turned(hand.global_orient))
        for side, hand in clip.hands.items()
    }
    return replace(
        clip,
        hands=hands,
        object=track(clip.object),
        other_objects=tuple(map(track, clip.other_objects)),
        gravity=None if clip.gravity is None else rotation.apply(clip.gravity),
        source_from_world=clip.source_from_world @ back,
        camera=camera,
    )


def mirror_image(clip: Clip) -> Clip:
    """Mirror a clip in x: axis-angles negate y and z, and the hands change sides."""
    rotvec_signs, hands = -MIRROR, {}
    for side, opposite in zip(SIDES, reversed(SIDES), strict=True):
        track = clip.hands[opposite]
        pose = (track.hand_pose.reshape(-1, 15, 3) * rotvec_signs).reshape(track.hand_pose.shape)
        hands[side] = replace(
            track, wrist_m=track.wrist_m * MIRROR, global_orient=track.global_orient * rotvec_signs, hand_pose=pose
        )
    model, track = clip.object.model, clip.object
    hinge = model.hinge and Hinge(model.hinge.axis * rotvec_signs, model.hinge.origin_m * MIRROR)
    image = ObjectModel(
        name="mirrored", vertices_m=model.vertices_m * MIRROR, faces=model.faces[:, ::-1], part=model.part, hinge=hinge
    )
    changes = {"rotvec": track.rotvec * rotvec_signs, "translation_m": track.translation_m * MIRROR}
    return with_object(replace(clip, hands=hands), model=image, **changes)
