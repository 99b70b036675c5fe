"""Fixtures shared by all tests. ``make_clip`` builds a small valid clip: an embedded hand that holds a moving box."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, Clip, HandTrack, HandType, ObjectTrack, Side
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.objects.model import Hinge, ObjectModel

BOX_M = (0.10, 0.08, 0.06)
TIP_GAP_M = 0.003


@pytest.fixture
def make_clip() -> Callable[..., Clip]:
    """Call it with n_frames, hand_type ("left", "right", "both"), articulated, seed, clip_id, subject, verb, gravity.

    The box moves along a smooth random path. An acting hand moves with it, its middle fingertip 3 mm above a face;
    a hand that does not act is valid too, but half a metre away.
    """
    return build_clip


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
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, n_frames)[:, None]
    rotation = rotvec_to_rotmat(rng.normal(0, 0.5, 3) + np.sin(time) * rng.normal(0, 0.5, 3))
    translation = np.array([0.1, 0.2, 0.8]) + time * rng.normal(0, 0.2, 3)
    model = hinged_box() if articulated else box()
    hands = {side: _hand(side, hand_type in (side, "both"), rotation, translation, rng) for side in SIDES}
    return Clip(
        clip_id=clip_id,
        dataset=clip_id.split("/")[0],
        subject=subject,
        sequence="/".join(clip_id.split("/")[1:]),
        hands=hands,
        object=ObjectTrack(
            model,
            rotmat_to_rotvec(rotation).astype(np.float32),
            translation.astype(np.float32),
            (0.4 * time[:, 0]).astype(np.float32) if articulated else None,
        ),
        source_frames=np.arange(n_frames, dtype=np.int32),
        gravity=None if gravity is None else np.array(gravity),
        verb=verb,
        object_words="box",
    )


def box() -> ObjectModel:
    """A rigid box, 10 x 8 x 6 cm, centred."""
    mesh = trimesh.creation.box(BOX_M)
    return ObjectModel("box", mesh.vertices, mesh.faces, np.zeros(8, dtype=np.uint8))


def hinged_box() -> ObjectModel:
    """The same box with a lid of 1 cm on its -y side that turns about an edge along x."""
    lid = trimesh.creation.box((BOX_M[0], 0.01, BOX_M[2]))
    lid.apply_translation([0, -BOX_M[1] / 2 - 0.005, 0])
    base = box()
    vertices = np.concatenate((base.vertices_m, lid.vertices))
    faces = np.concatenate((base.faces, lid.faces + 8))
    hinge = Hinge(np.array([1.0, 0.0, 0.0]), np.array([0.0, -BOX_M[1] / 2, -BOX_M[2] / 2]))
    return ObjectModel("hinged_box", vertices, faces, np.repeat(np.array([0, 1], dtype=np.uint8), 8), hinge)


def _hand(
    side: Side, acting: bool, rotation: np.ndarray, translation: np.ndarray, rng: np.random.Generator
) -> HandTrack:
    pose, betas = rng.normal(0, 0.1, 45), rng.normal(0, 0.5, (1, 10))
    orient = Rotation.from_euler("y", 90 if side == "left" else -90, degrees=True).as_matrix()
    from_wrist = _middle_tip(side, orient, pose, betas)
    face = np.array([0.0, 0.0, BOX_M[2] / 2 + TIP_GAP_M]) if acting else np.array([0.5, 0.0, 0.5])
    # Each hand has its own half of the top face.
    face[1] += 0.02 if side == "left" else -0.02
    return HandTrack(
        wrist_m=(rotation @ (face - from_wrist) + translation).astype(np.float32),
        global_orient=rotmat_to_rotvec(rotation @ orient).astype(np.float32),
        hand_pose=np.repeat(pose[None], len(rotation), axis=0).astype(np.float32),
        betas=betas.astype(np.float32),
        valid=np.ones(len(rotation), dtype=bool),
    )


def _middle_tip(side: Side, orient: np.ndarray, pose: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """(3,) from the wrist to the tip of the middle finger."""
    at_origin = HandTrack(np.zeros((1, 3)), rotmat_to_rotvec(orient)[None], pose[None], betas, np.ones(1, dtype=bool))
    return track_joints(at_origin, load_embedded_hands()[side])[0, 17]
