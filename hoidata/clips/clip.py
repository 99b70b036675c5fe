"""What a clip is: one hand-object interaction in one frame of reference, whatever dataset it came from.

World frame: the source's own world made right-handed; metres, radians, 30 frames per second, column vectors.
Frame axis first in every array. Joint order: MANO's 16 (wrist, index, middle, pinky, ring, thumb), then the tips of
index, middle, pinky, ring, thumb.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np

from hoidata.objects.model import ObjectModel

FPS = 30
Side = Literal["left", "right"]
HandType = Literal["left", "right", "both"]
SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class HandTrack:
    """MANO-layout parameters of one hand, absolute and in the world frame.

    wrist_m: (frame, 3) world position of joint 0, metres. Not MANO's ``transl``: joint 0 lies exactly here.
    global_orient: (frame, 3) axis-angle, radians, world frame; the hand turns about its wrist joint.
    hand_pose: (frame, 45) axis-angle of the 15 finger joints, absolute (zero is the flat hand), never mean-relative.
    betas: (1, 10) for the whole clip or (frame, 10).
    valid: (frame,) bool; a False frame holds finite numbers that mean nothing.
    template_m: (778, 3) personal rest mesh that replaces the model's template, or None.
    """

    wrist_m: np.ndarray
    global_orient: np.ndarray
    hand_pose: np.ndarray
    betas: np.ndarray
    valid: np.ndarray
    template_m: np.ndarray | None = None

    @property
    def n_frames(self) -> int:
        return len(self.wrist_m)


@dataclass(frozen=True)
class ObjectTrack:
    """Motion of one object.

    model: canonical mesh, parts and hinge.
    rotvec: (frame, 3) axis-angle of ``world_from_object``, radians, column-vector convention.
    translation_m: (frame, 3) world position of the object frame's origin.
    hinge_rad: (frame,) unwrapped hinge angle, or None for a rigid object.
    """

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


@dataclass(frozen=True)
class CameraTrack:
    """A camera that saw the clip, so that frames link back to images.

    name: as in the source (``cam4``). rotvec: (frame, 3) axis-angle and position_m: (frame, 3) of
    ``world_from_camera``, OpenCV axes (x right, y down, z ahead). images: (frame,) int32 number of each image in the
    source. intrinsics: (6,) fx, fy, cx, cy, width, height in pixels, or None.
    """

    name: str
    rotvec: np.ndarray
    position_m: np.ndarray
    images: np.ndarray
    intrinsics: np.ndarray | None = None


@dataclass(frozen=True)
class BodyTrack:
    """SMPL-X parameters of the person (Pavlakos et al. 2019) as the source gives them, in the clip's world frame.

    transl_m: (frame, 3); global_orient: (frame, 3); body_pose: (frame, 63); face_pose: (frame, 9) jaw, left eye, right
    eye; axis-angles in radians. expression: (frame, 10) or None. The hands are those of ``Clip.hands``.
    """

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
    source_frames: (frame,) int32 index of each frame in the source file, counted from 0.
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

    def cut(self, start: int, stop: int) -> "Clip":
        """Frames ``start`` to ``stop`` (exclusive) as a clip of its own, under the same id."""
        frames = slice(start, stop)
        return replace(
            self,
            hands={side: _cut_hand(track, frames) for side, track in self.hands.items()},
            object=_cut_object(self.object, frames),
            other_objects=tuple(_cut_object(track, frames) for track in self.other_objects),
            source_frames=self.source_frames[frames],
            camera=None if self.camera is None else _cut_arrays(self.camera, frames, "rotvec", "position_m", "images"),
            body=None if self.body is None else _cut_body(self.body, frames),
            source_contact=None if self.source_contact is None else _cut_contact(self.source_contact, start, stop),
        )


def _cut_hand(track: HandTrack, frames: slice) -> HandTrack:
    return replace(
        track,
        wrist_m=track.wrist_m[frames],
        global_orient=track.global_orient[frames],
        hand_pose=track.hand_pose[frames],
        betas=track.betas if len(track.betas) == 1 else track.betas[frames],
        valid=track.valid[frames],
    )


def _cut_object(track: ObjectTrack, frames: slice) -> ObjectTrack:
    hinge = None if track.hinge_rad is None else track.hinge_rad[frames]
    return replace(track, rotvec=track.rotvec[frames], translation_m=track.translation_m[frames], hinge_rad=hinge)


def _cut_body(track: BodyTrack, frames: slice) -> BodyTrack:
    names = ("transl_m", "global_orient", "body_pose", "face_pose")
    return _cut_arrays(track, frames, *names, *(() if track.expression is None else ("expression",)))


def _cut_contact(contact: SourceContact, start: int, stop: int) -> SourceContact:
    kept = (contact.frame >= start) & (contact.frame < stop)
    return SourceContact(contact.frame[kept] - start, contact.vertex[kept], contact.label[kept])


Track = TypeVar("Track", CameraTrack, BodyTrack)


def _cut_arrays(track: Track, frames: slice, *names: str) -> Track:
    return replace(track, **{name: getattr(track, name)[frames] for name in names})
