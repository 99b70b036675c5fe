"""Checks that a clip satisfies the rules of ``Clip``."""

import numpy as np

from hoidata.clips.clip import FPS, SIDES, BodyTrack, CameraTrack, Clip, HandTrack, ObjectTrack, SourceContact
from hoidata.errors import BadInput
from hoidata.hands.model import N_VERTICES

REMEDY = "the adapter broke a rule of Clip: report it"
FARTHEST_M = 100.0  # larger than any capture volume: a position beyond it has a wrong unit
OBJECT_SIZE_M = (0.001, 10.0)  # longest side of a mesh; millimetres read as metres are far outside
HAND_SIZE_M = (0.05, 0.5)
UNIT_TOLERANCE = 1e-6  # of the length of a direction


def check_clip(clip: Clip) -> Clip:
    """Check shapes, finite numbers, equal frame counts and plausible units, and return the clip.

    Raises BadInput with the clip and the field.
    """
    n_frames = clip.n_frames
    if n_frames < 1 or not frame_numbers_rise(clip.source_frames, clip.source_fps):
        raise BadInput(f"{clip.clip_id}: source_frames", "1 or more rising frame numbers", f"{n_frames}", REMEDY)
    if tuple(clip.hands) != SIDES:
        raise BadInput(f"{clip.clip_id}: hands", f"{SIDES}", f"{tuple(clip.hands)}", REMEDY)
    for side, track in clip.hands.items():
        _check_hand(f"{clip.clip_id}: {side} hand", track, n_frames)
    for number, track in enumerate((clip.object, *clip.other_objects)):
        _check_object(f"{clip.clip_id}: object {number} ({track.model.name})", track, n_frames)
    _check_world(clip)
    _check_origin(clip)
    if clip.camera is not None:
        _check_camera(f"{clip.clip_id}: camera", clip.camera, n_frames)
    if clip.body is not None:
        _check_body(f"{clip.clip_id}: body", clip.body, n_frames)
    if clip.source_contact is not None:
        _check_contact(f"{clip.clip_id}: source_contact", clip.source_contact, n_frames, clip.object)
    return clip


def frame_numbers_rise(source_frames: np.ndarray, source_fps: float) -> bool:
    """Whether the numbers (frame,) of source frames rise. Interpolated frames repeat the number before them.

    A source with 30 fps or more must skip as many numbers as there are interpolated frames.
    """
    recorded = np.flatnonzero(np.diff(source_frames, prepend=source_frames[:1] - 1))
    steps = np.diff(source_frames[recorded])
    return bool((steps > 0).all() and (source_fps < FPS or (steps >= np.diff(recorded)).all()))


def _check_world(clip: Clip) -> None:
    field = f"{clip.clip_id}: gravity"
    if clip.gravity is None and not clip.gravity_note:
        raise BadInput(f"{field}_note", "why the direction of gravity is not known", "an empty text", REMEDY)
    if clip.gravity is not None and not (
        np.shape(clip.gravity) == (3,) and abs(np.linalg.norm(clip.gravity) - 1) <= UNIT_TOLERANCE
    ):
        raise BadInput(field, "a unit vector or None", f"{clip.gravity}", REMEDY)
    field, matrix = f"{clip.clip_id}: source_from_world", np.asarray(clip.source_from_world)
    _check_array(field, matrix, (4, 4))
    if not np.array_equal(matrix[3], (0, 0, 0, 1)) or abs(np.linalg.det(matrix)) < 1e-12:
        raise BadInput(field, "an invertible transform with last row 0 0 0 1", f"{matrix.tolist()}", REMEDY)


def _check_origin(clip: Clip) -> None:
    """Check the origin of the numbers: fitted hands and frame rate."""
    if clip.hands_from not in ("parameters", "keypoints"):
        raise BadInput(f"{clip.clip_id}: hands_from", "parameters or keypoints", f"{clip.hands_from!r}", REMEDY)
    fitted, error_m = clip.hands_from == "keypoints", clip.fit_error_m
    if (error_m is not None) != fitted or (error_m is not None and not 0 <= error_m < FARTHEST_M):
        expected = "metres, 0 or more, for hands fitted to keypoints" if fitted else "None for parameters of the source"
        raise BadInput(f"{clip.clip_id}: fit_error_m", expected, f"{error_m}", REMEDY)
    if not (np.isfinite(clip.source_fps) and clip.source_fps > 0):
        raise BadInput(f"{clip.clip_id}: source_fps", "a positive number", f"{clip.source_fps}", REMEDY)


def _check_camera(field: str, track: CameraTrack, n_frames: int) -> None:
    _check_array(f"{field}.rotvec", track.rotvec, (n_frames, 3))
    _check_array(f"{field}.position_m", track.position_m, (n_frames, 3))
    _check_positions(f"{field}.position_m", track.position_m)
    _check_whole(f"{field}.images", track.images, (n_frames,))
    if track.intrinsics is not None:
        _check_array(f"{field}.intrinsics", track.intrinsics, (6,))


def _check_body(field: str, track: BodyTrack, n_frames: int) -> None:
    for name, columns in (("transl_m", 3), ("global_orient", 3), ("body_pose", 63), ("face_pose", 9)):
        _check_array(f"{field}.{name}", getattr(track, name), (n_frames, columns))
    if track.expression is not None:
        _check_array(f"{field}.expression", track.expression, (n_frames, 10))
    _check_positions(f"{field}.transl_m", track.transl_m)


def _check_contact(field: str, contact: SourceContact, n_frames: int, track: ObjectTrack) -> None:
    entries = (len(contact.frame),)
    for name, below in (("frame", n_frames), ("vertex", len(track.model.vertices_m)), ("label", 256)):
        numbers = getattr(contact, name)
        _check_whole(f"{field}.{name}", numbers, entries)
        if len(numbers) and not (numbers.min() >= 0 and numbers.max() < below):
            got = f"{numbers.min()} to {numbers.max()}"
            raise BadInput(f"{field}.{name}", f"numbers from 0 to {below - 1}", got, REMEDY)
    order = contact.frame.astype(np.int64) * len(track.model.vertices_m) + contact.vertex
    if np.any(np.diff(order) <= 0):
        raise BadInput(field, "entries sorted by frame, then vertex, each once", "another order", REMEDY)


def _check_hand(field: str, track: HandTrack, n_frames: int) -> None:
    for name, columns in (("wrist_m", 3), ("global_orient", 3), ("hand_pose", 45)):
        _check_array(f"{field}.{name}", getattr(track, name), (n_frames, columns))
    _check_array(f"{field}.betas", track.betas, (1 if len(track.betas) == 1 else n_frames, 10))
    if track.valid.dtype != bool or track.valid.shape != (n_frames,):
        raise BadInput(f"{field}.valid", f"{n_frames} booleans", f"{track.valid.dtype} {track.valid.shape}", REMEDY)
    if track.template_m is not None:
        _check_array(f"{field}.template_m", track.template_m, (N_VERTICES, 3))
        _check_size(f"{field}.template_m", track.template_m, HAND_SIZE_M)
    _check_positions(f"{field}.wrist_m", track.wrist_m[track.valid])


def _check_object(field: str, track: ObjectTrack, n_frames: int) -> None:
    _check_array(f"{field}.rotvec", track.rotvec, (n_frames, 3))
    _check_array(f"{field}.translation_m", track.translation_m, (n_frames, 3))
    _check_positions(f"{field}.translation_m", track.translation_m)
    _check_size(f"{field}.model.vertices_m", track.model.vertices_m, OBJECT_SIZE_M)
    if (track.hinge_rad is not None) != track.model.is_articulated:
        raise BadInput(f"{field}.hinge_rad", "an angle exactly where the model has a hinge", "otherwise", REMEDY)
    if track.hinge_rad is not None:
        _check_array(f"{field}.hinge_rad", track.hinge_rad, (n_frames,))


def _check_array(field: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise BadInput(field, f"shape {shape}", f"{array.shape}", REMEDY)
    if array.dtype.kind != "f" or not np.isfinite(array).all():
        raise BadInput(field, "finite floats", f"{array.dtype} with NaN, infinity or another kind", REMEDY)


def _check_whole(field: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype.kind not in "iu":
        raise BadInput(field, f"whole numbers of shape {shape}", f"{array.dtype} {array.shape}", REMEDY)


def _check_positions(field: str, positions_m: np.ndarray) -> None:
    if len(positions_m) and np.abs(positions_m).max() > FARTHEST_M:
        farthest = f"{np.abs(positions_m).max():.3g} m"
        raise BadInput(field, f"places within {FARTHEST_M:g} m of the origin", farthest, "check the unit of the file")


def _check_size(field: str, vertices_m: np.ndarray, expected_m: tuple[float, float]) -> None:
    size_m = float(np.ptp(vertices_m, axis=0).max())
    if not expected_m[0] <= size_m <= expected_m[1]:
        expected = f"a mesh {expected_m[0]:g} to {expected_m[1]:g} m long"
        raise BadInput(field, expected, f"{size_m:.3g} m", "check the unit of the mesh file")
