"""The data model of a clip: one hand-object interaction, in the same form for all datasets.

World frame: the world of the source made right-handed; metres, radians, 30 frames per second, column vectors.
The frame axis comes first in all arrays. Joint order: MANO's 16 (wrist, index, middle, pinky, ring, thumb), then the
tips of index, middle, pinky, ring, thumb.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, Self

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.objects.model import ObjectModel, articulate

FPS = 30
Side = Literal["left", "right"]
HandType = Literal["left", "right", "both"]
SIDES: tuple[Side, Side] = ("left", "right")
Frames = slice | np.ndarray


class Track:
    """Base class of data with one row per frame."""

    PER_FRAME: ClassVar[tuple[str, ...]]  # names of the arrays with one row per frame; absent ones are None

    def take(self, frames: Frames) -> Self:
        """Select frames: a slice, or (frame,) numbers counted from 0."""
        arrays = {name: getattr(self, name) for name in self.PER_FRAME}
        selected = {name: array[frames] for name, array in arrays.items() if array is not None}
        return replace(self, **selected)  # pyright: ignore[reportArgumentType, reportCallIssue]


@dataclass(frozen=True)
class HandTrack(Track):
    """Parameters of one hand in MANO's layout, absolute, world frame.

    Adapters give rotation angles of at most pi. The axis flips when an angle passes pi, so compare rotations instead of
    these numbers.
    """

    PER_FRAME = ("wrist_m", "global_orient", "hand_pose", "valid")

    wrist_m: np.ndarray  # (frame, 3) world position of joint 0, metres; not MANO's ``transl``
    global_orient: np.ndarray  # (frame, 3) axis-angle, radians, world frame; rotation about the wrist joint
    hand_pose: np.ndarray  # (frame, 45) axis-angles of the 15 finger joints, absolute: zero is the flat hand
    betas: np.ndarray  # (1, 10) for the whole clip, or (frame, 10)
    valid: np.ndarray  # (frame,) bool; False: the hand is not tracked, its numbers are finite but meaningless
    template_m: np.ndarray | None = None  # (778, 3) personal rest mesh that replaces the model's template

    @property
    def n_frames(self) -> int:
        return len(self.wrist_m)

    @property
    def mean_betas(self) -> np.ndarray:
        """(10,) mean shape over the valid frames, or over all frames if none is valid."""
        if len(self.betas) == 1 or not self.valid.any():
            return self.betas.mean(axis=0)
        return self.betas[self.valid].mean(axis=0)

    @property
    def last_valid_frames(self) -> np.ndarray:
        """(frame,) index of the last valid frame up to each frame; before the first valid frame, its index.

        A hand that is never valid gets the index of each frame.
        """
        frames, valid = np.arange(self.n_frames), np.flatnonzero(self.valid)
        if not len(valid):
            return frames
        return valid[np.maximum(np.searchsorted(valid, frames, side="right") - 1, 0)]

    def with_last_valid_pose(self) -> "HandTrack":
        """Replace invalid poses by those of ``last_valid_frames``. ``valid`` is unchanged."""
        return replace(self.take(self.last_valid_frames), valid=self.valid)

    def take(self, frames: Frames) -> "HandTrack":
        """Select frames. A single shape for the whole clip is unchanged."""
        return replace(super().take(frames), betas=self.betas if len(self.betas) == 1 else self.betas[frames])


@dataclass(frozen=True)
class ObjectTrack(Track):
    """Motion of one object."""

    PER_FRAME = ("rotvec", "translation_m", "hinge_rad")

    model: ObjectModel  # canonical mesh, parts and hinge
    rotvec: np.ndarray  # (frame, 3) axis-angle of ``world_from_object``, radians
    translation_m: np.ndarray  # (frame, 3) world position of the object frame's origin
    # (frame,) unwrapped hinge angle, or displacement of a prismatic joint in metres; None for a rigid object
    hinge_rad: np.ndarray | None = None

    @property
    def joint_angle_rad(self) -> np.ndarray | None:
        """(frame,) ``hinge_rad`` with the positions of a prismatic joint as angles (``ObjectModel.joint_scale``)."""
        return self.hinge_rad if self.hinge_rad is None else self.hinge_rad / np.float32(self.model.joint_scale)

    @property
    def is_articulated(self) -> bool:
        return self.model.is_articulated

    @property
    def n_frames(self) -> int:
        return len(self.translation_m)

    @property
    def world_from_object(self) -> RigidTransform:
        """The pose of each frame, (frame,) transforms in float64."""
        rotvec, translation_m = (np.asarray(array, dtype=np.float64) for array in (self.rotvec, self.translation_m))
        return RigidTransform.from_rotvec(rotvec, translation_m)

    def points_in_world(self, points_m: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return (frame, point, 3) world positions of points of the object, metres.

        Args:
            points_m: (point, 3) at hinge angle 0, object frame.
            part: (point,) part of each point, 0 or 1.
        """
        return self.world_from_object @ articulate(points_m, part, self.model.hinge, self.hinge_rad)

    def lowest_m(self, up: np.ndarray) -> np.ndarray:
        """(frame,) height of the lowest vertex above the world's origin, along the unit vector ``up``."""
        return self.model.lowest_m(self.world_from_object, self.hinge_rad, up)


@dataclass(frozen=True)
class CameraTrack(Track):
    """Pose of a camera and the image of each frame. OpenCV axes: x right, y down, z forward."""

    PER_FRAME = ("rotvec", "position_m", "images")

    name: str  # as in the source (``cam4``)
    rotvec: np.ndarray  # (frame, 3) axis-angle of ``world_from_camera``
    position_m: np.ndarray  # (frame, 3) world
    images: np.ndarray  # (frame,) int32 number of each image in the source
    intrinsics: np.ndarray | None = None  # (6,) fx, fy, cx, cy, width, height in pixels


@dataclass(frozen=True)
class BodyTrack(Track):
    """SMPL-X parameters of the person (Pavlakos et al. 2019), world frame; axis-angles in radians."""

    PER_FRAME = ("transl_m", "global_orient", "body_pose", "face_pose", "expression")

    transl_m: np.ndarray  # (frame, 3)
    global_orient: np.ndarray  # (frame, 3)
    body_pose: np.ndarray  # (frame, 63), without hands
    face_pose: np.ndarray  # (frame, 9) jaw, left eye, right eye
    expression: np.ndarray | None = None  # (frame, 10)


@dataclass(frozen=True)
class SourceContact:
    """Contact labels of the source: one entry per frame and touched vertex of the object, sorted by frame, vertex."""

    frame: np.ndarray  # (entry,) int32 frame of the clip
    vertex: np.ndarray  # (entry,) int32 vertex of the clip's object mesh
    # (entry,) uint8: what touches, in the source's numbering (GRAB: 21 left hand, 22 right hand, 26-40 left fingers,
    # 41-55 right fingers)
    label: np.ndarray

    def take(self, frames: Frames, n_frames: int) -> "SourceContact":
        """Select the entries of some frames of a clip of ``n_frames``, and renumber the frames from 0."""
        selected = np.arange(n_frames)[frames]
        first, stop = np.searchsorted(self.frame, selected), np.searchsorted(self.frame, selected, side="right")
        count = stop - first
        new_frame = np.repeat(np.arange(len(selected), dtype=self.frame.dtype), count)
        entry = np.arange(len(new_frame)) + np.repeat(first - (np.cumsum(count) - count), count)
        return SourceContact(new_frame, self.vertex[entry], self.label[entry])


@dataclass(frozen=True)
class WorldFrame:
    """The world frame of a dataset, made right-handed."""

    up_axis: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None  # None if the source does not state it
    gravity: Literal["stated", "estimated", "unknown"]  # source of a clip's gravity
    note: str  # one sentence for people


@dataclass(frozen=True)
class SourceFile:
    """A raw file, or folder of per-frame files, that a clip was read from."""

    path: str  # below the raw root
    size: int  # bytes
    sha256: str


@dataclass(frozen=True)
class Clip:
    """One interaction at 30 fps."""

    clip_id: str  # stable, from the source's names: ``grab/s1/mug_drink_1``, ``arctic/s01/box_grab_01/0012-0100``
    dataset: str
    subject: str  # as in the source
    sequence: str  # source sequence that the clip is cut from
    hands: dict[Side, HandTrack]  # always both sides
    object: ObjectTrack  # the manipulated object
    source_frames: np.ndarray  # (frame,) int32 index in the source file; an interpolated frame repeats the one before
    gravity: np.ndarray | None  # (3,) unit vector, world frame; None if unknown
    verb: str | None  # "take out", "hand over"; None without a label
    object_words: str  # noun without article: "large cube"
    labelled_hand: HandType | None = None  # hand named by a human annotator
    other_objects: tuple[ObjectTrack, ...] = ()  # further tracked objects of the scene
    # (4, 4): world points to the frame and unit of the source
    source_from_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    sources: tuple[SourceFile, ...] = ()  # all raw files behind the clip
    synthetic: bool = False  # whether the raw data was generated
    source_fps: float = float(FPS)
    gravity_note: str = ""  # how gravity was estimated, or why it is unknown; empty if the source states it
    hands_from: Literal["parameters", "keypoints"] = "parameters"  # hands of the source, or fitted to keypoints
    # mean error of fitted hands over the valid frames, of segments over the whole recording; None for parameters
    fit_error_m: float | None = None
    camera: CameraTrack | None = None
    body: BodyTrack | None = None
    source_contact: SourceContact | None = None

    @property
    def n_frames(self) -> int:
        return len(self.source_frames)

    @property
    def recorded(self) -> np.ndarray:
        """(frame,) bool: True for frames of the source, False for interpolated ones."""
        return np.diff(self.source_frames, prepend=self.source_frames[:1] - 1) != 0

    def take(self, frames: Frames) -> "Clip":
        """Select frames as a clip with the same id; the spacing of frames is not checked."""
        return replace(
            self,
            hands={side: track.take(frames) for side, track in self.hands.items()},
            object=self.object.take(frames),
            other_objects=tuple(track.take(frames) for track in self.other_objects),
            source_frames=self.source_frames[frames],
            camera=None if self.camera is None else self.camera.take(frames),
            body=None if self.body is None else self.body.take(frames),
            source_contact=None if self.source_contact is None else self.source_contact.take(frames, self.n_frames),
        )
