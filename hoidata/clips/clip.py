"""What a clip is: one hand-object interaction in one frame of reference, whatever dataset it came from.

World frame: the source's own world made right-handed; metres, radians, 30 frames per second, column vectors.
Frame axis first in every array. Joint order: MANO's 16 (wrist, index, middle, pinky, ring, thumb), then the tips of
index, middle, pinky, ring, thumb.
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
    """What has one row per frame. ``PER_FRAME`` names the arrays that have; None stands for one that is not there."""

    PER_FRAME: ClassVar[tuple[str, ...]]

    def take(self, frames: Frames) -> Self:
        """Some frames of it: a slice, or (frame,) numbers counted from 0."""
        arrays = {name: getattr(self, name) for name in self.PER_FRAME}
        rows = {name: array[frames] for name, array in arrays.items() if array is not None}
        return replace(self, **rows)  # pyright: ignore[reportArgumentType, reportCallIssue]


@dataclass(frozen=True)
class HandTrack(Track):
    """MANO-layout parameters of one hand, absolute and in the world frame.

    wrist_m: (frame, 3) world position of joint 0, metres. Not MANO's ``transl``: joint 0 lies exactly here.
    global_orient: (frame, 3) axis-angle, radians, world frame; the hand turns about its wrist joint.
    hand_pose: (frame, 45) axis-angle of the 15 finger joints, absolute (zero is the flat hand), never mean-relative.
    Adapters give rotations of at most pi. Where one passes pi its axis flips: compare rotations, not these numbers.
    betas: (1, 10) for the whole clip or (frame, 10).
    valid: (frame,) bool; a False frame holds finite numbers that mean nothing.
    template_m: (778, 3) personal rest mesh that replaces the model's template, or None.
    """

    PER_FRAME = ("wrist_m", "global_orient", "hand_pose", "valid")

    wrist_m: np.ndarray
    global_orient: np.ndarray
    hand_pose: np.ndarray
    betas: np.ndarray
    valid: np.ndarray
    template_m: np.ndarray | None = None

    @property
    def n_frames(self) -> int:
        return len(self.wrist_m)

    @property
    def mean_betas(self) -> np.ndarray:
        """(10,) one shape for the clip: the mean over the valid frames, over all where none is."""
        if len(self.betas) == 1 or not self.valid.any():
            return self.betas.mean(axis=0)
        return self.betas[self.valid].mean(axis=0)

    @property
    def shown_frames(self) -> np.ndarray:
        """(frame,) the frame whose pose stands in for each: itself if valid, else the last valid one before it.

        Before the first valid frame that one; of a hand that is never valid each frame itself.
        """
        frames, valid = np.arange(self.n_frames), np.flatnonzero(self.valid)
        if not len(valid):
            return frames
        return valid[np.maximum(np.searchsorted(valid, frames, side="right") - 1, 0)]

    def held(self) -> "HandTrack":
        """The hand with the poses of ``shown_frames``; ``valid`` stays."""
        return replace(self.take(self.shown_frames), valid=self.valid)

    def take(self, frames: Frames) -> "HandTrack":
        """Some frames of it; one shape for the whole clip stays one shape."""
        return replace(super().take(frames), betas=self.betas if len(self.betas) == 1 else self.betas[frames])


@dataclass(frozen=True)
class ObjectTrack(Track):
    """Motion of one object.

    model: canonical mesh, parts and hinge.
    rotvec: (frame, 3) axis-angle of ``world_from_object``, radians, column-vector convention.
    translation_m: (frame, 3) world position of the object frame's origin.
    hinge_rad: (frame,) unwrapped hinge angle, or None for a rigid object.
    """

    PER_FRAME = ("rotvec", "translation_m", "hinge_rad")

    model: ObjectModel
    rotvec: np.ndarray
    translation_m: np.ndarray
    hinge_rad: np.ndarray | None = None

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
        """(frame, point, 3) world positions of points of the object, metres.

        points_m: (point, 3) at hinge angle 0, object frame. part: (point,) the part each belongs to, 0 or 1.
        """
        return self.world_from_object @ articulate(points_m, part, self.model.hinge, self.hinge_rad)


@dataclass(frozen=True)
class CameraTrack(Track):
    """A camera that saw the clip, so that frames link back to images.

    name: as in the source (``cam4``). rotvec: (frame, 3) axis-angle and position_m: (frame, 3) of
    ``world_from_camera``, OpenCV axes (x right, y down, z ahead). images: (frame,) int32 number of each image in the
    source. intrinsics: (6,) fx, fy, cx, cy, width, height in pixels, or None.
    """

    PER_FRAME = ("rotvec", "position_m", "images")

    name: str
    rotvec: np.ndarray
    position_m: np.ndarray
    images: np.ndarray
    intrinsics: np.ndarray | None = None


@dataclass(frozen=True)
class BodyTrack(Track):
    """SMPL-X parameters of the person (Pavlakos et al. 2019) as the source gives them, in the clip's world frame.

    transl_m: (frame, 3); global_orient: (frame, 3); body_pose: (frame, 63); face_pose: (frame, 9) jaw, left eye, right
    eye; axis-angles in radians. expression: (frame, 10) or None. The hands are those of ``Clip.hands``.
    """

    PER_FRAME = ("transl_m", "global_orient", "body_pose", "face_pose", "expression")

    transl_m: np.ndarray
    global_orient: np.ndarray
    body_pose: np.ndarray
    face_pose: np.ndarray
    expression: np.ndarray | None = None


@dataclass(frozen=True)
class SourceContact:
    """Contact labels that came with the source: one entry per touched vertex of the clip's object mesh and frame.

    frame: (entry,) int32 frame of the clip; vertex: (entry,) int32; label: (entry,) uint8, the source's own number of
    what touches (GRAB: 21 left hand, 22 right hand, 26-40 left fingers, 41-55 right fingers). Sorted by frame, vertex.
    """

    frame: np.ndarray
    vertex: np.ndarray
    label: np.ndarray

    def take(self, frames: Frames, n_frames: int) -> "SourceContact":
        """The entries of some frames of a clip of ``n_frames``, counted from the first of those taken."""
        kept = np.arange(n_frames)[frames]
        first, stop = np.searchsorted(self.frame, kept), np.searchsorted(self.frame, kept, side="right")
        count = stop - first
        new_frame = np.repeat(np.arange(len(kept), dtype=self.frame.dtype), count)
        entry = np.arange(len(new_frame)) + np.repeat(first - (np.cumsum(count) - count), count)
        return SourceContact(new_frame, self.vertex[entry], self.label[entry])


@dataclass(frozen=True)
class WorldFrame:
    """What a dataset says about its world, made right-handed.

    up_axis: ``+z``, ``+y`` and so on, or None when the source does not say. gravity: where a clip's gravity comes
    from. note: one sentence for people.
    """

    up_axis: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None
    gravity: Literal["stated", "estimated", "unknown"]
    note: str


@dataclass(frozen=True)
class SourceFile:
    """One raw file (or folder of per-frame files) a clip was read from: path below the raw root, bytes, SHA-256."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Clip:
    """One interaction, 30 fps.

    clip_id: stable id made from the source key, e.g. ``grab/s1/mug_drink_1`` or ``arctic/s01/box_grab_01/0012-0100``.
    dataset, subject: names as in the source. sequence: the source sequence the clip was cut from.
    hands: both sides always present; ``valid`` says which frames mean something.
    object: the manipulated object; other_objects: further tracked objects of the scene.
    source_frames: (frame,) int32 index of each frame in the source file, counted from 0. A frame that was made between
    two (a source below 30 fps, a short gap in an object's poses) has the number of the one before it (``recorded``).
    gravity: (3,) unit vector, the direction things fall in the world frame, or None when it is not known.
    gravity_note: empty where the source states gravity; else how it was estimated, or why it is not known.
    verb: the action in words ("take out", "hand over"), or None when the source has no label.
    object_words: noun of the object in words ("large cube"), without article.
    labelled_hand: the hand a human annotator named, or None.
    source_from_world: (4, 4) takes world points back to the source's own frame and unit.
    sources: every raw file behind the clip. synthetic: True when the raw data was generated.
    hands_from: "parameters" of the source, or "keypoints" to which a hand was fitted with the mean error
    ``fit_error_m`` over all valid frames of both hands (None for parameters).
    camera, body, source_contact: what else the source offers, None where it does not.
    """

    clip_id: str
    dataset: str
    subject: str
    sequence: str
    hands: dict[Side, HandTrack]
    object: ObjectTrack
    source_frames: np.ndarray
    gravity: np.ndarray | None
    verb: str | None
    object_words: str
    labelled_hand: HandType | None = None
    other_objects: tuple[ObjectTrack, ...] = ()
    source_from_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    sources: tuple[SourceFile, ...] = ()
    synthetic: bool = False
    source_fps: float = float(FPS)
    gravity_note: str = ""
    hands_from: Literal["parameters", "keypoints"] = "parameters"
    fit_error_m: float | None = None
    camera: CameraTrack | None = None
    body: BodyTrack | None = None
    source_contact: SourceContact | None = None

    @property
    def n_frames(self) -> int:
        return len(self.source_frames)

    @property
    def recorded(self) -> np.ndarray:
        """(frame,) bool: a frame of the source, not one that was made between two of them."""
        return np.diff(self.source_frames, prepend=self.source_frames[:1] - 1) != 0

    def take(self, frames: Frames) -> "Clip":
        """Some frames as a clip of its own, under the same id.

        frames: a slice, or (frame,) numbers counted from 0. Frames that are not 1/30 s apart are the caller's affair.
        """
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
