"""What must hold of every clip, whatever adapter made it."""

import numpy as np

from hoidata.errors import BadInput
from hoidata.schema.clip import SIDES, Clip, HandTrack, ObjectTrack

REMEDY = "the adapter broke a rule of Clip: report it"
FARTHEST_M = 100.0  # a place farther from the origin than any capture room is wide means a wrong unit
OBJECT_SIZE_M = (0.001, 10.0)  # the longest side of a mesh: millimetres or metres taken for each other are far outside
HAND_SIZE_M = (0.05, 0.5)


def check_clip(clip: Clip) -> Clip:
    """The clip itself, after checking shapes, finite numbers, equal frame counts and plausible units.

    Raises BadInput that names the clip and the field.
    """
    n_frames = clip.n_frames
    if n_frames < 1 or np.any(np.diff(clip.source_frames) <= 0):
        raise BadInput(f"{clip.clip_id}: source_frames", "1 or more rising frame numbers", f"{n_frames}", REMEDY)
    if tuple(clip.hands) != SIDES:
        raise BadInput(f"{clip.clip_id}: hands", f"{SIDES}", f"{tuple(clip.hands)}", REMEDY)
    for side, track in clip.hands.items():
        _check_hand(f"{clip.clip_id}: {side} hand", track, n_frames)
    for number, track in enumerate((clip.object, *clip.other_objects)):
        _check_object(f"{clip.clip_id}: object {number} ({track.model.name})", track, n_frames)
    if clip.gravity is not None and abs(np.linalg.norm(clip.gravity) - 1) > 1e-6:
        raise BadInput(f"{clip.clip_id}: gravity", "a unit vector or None", f"{clip.gravity}", REMEDY)
    return clip


def _check_hand(where: str, track: HandTrack, n_frames: int) -> None:
    for name, columns in (("wrist_m", 3), ("global_orient", 3), ("hand_pose", 45)):
        _check_array(f"{where}.{name}", getattr(track, name), (n_frames, columns))
    _check_array(f"{where}.betas", track.betas, (1 if len(track.betas) == 1 else n_frames, 10))
    if track.valid.dtype != bool or track.valid.shape != (n_frames,):
        raise BadInput(f"{where}.valid", f"{n_frames} booleans", f"{track.valid.dtype} {track.valid.shape}", REMEDY)
    if track.template_m is not None:
        _check_array(f"{where}.template_m", track.template_m, (778, 3))
        _check_size(f"{where}.template_m", track.template_m, HAND_SIZE_M)
    _check_places(f"{where}.wrist_m", track.wrist_m[track.valid])


def _check_object(where: str, track: ObjectTrack, n_frames: int) -> None:
    _check_array(f"{where}.rotvec", track.rotvec, (n_frames, 3))
    _check_array(f"{where}.translation_m", track.translation_m, (n_frames, 3))
    _check_places(f"{where}.translation_m", track.translation_m)
    _check_size(f"{where}.model.vertices_m", track.model.vertices_m, OBJECT_SIZE_M)
    if (track.hinge_rad is not None) != track.model.is_articulated:
        raise BadInput(f"{where}.hinge_rad", "an angle exactly where the model has a hinge", "otherwise", REMEDY)
    if track.hinge_rad is not None:
        _check_array(f"{where}.hinge_rad", track.hinge_rad, (n_frames,))


def _check_array(where: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise BadInput(where, f"shape {shape}", f"{array.shape}", REMEDY)
    if array.dtype.kind != "f" or not np.isfinite(array).all():
        raise BadInput(where, "finite floats", f"{array.dtype} with NaN, infinity or another kind", REMEDY)


def _check_places(where: str, places_m: np.ndarray) -> None:
    if len(places_m) and np.abs(places_m).max() > FARTHEST_M:
        farthest = f"{np.abs(places_m).max():.3g} m"
        raise BadInput(where, f"places within {FARTHEST_M:g} m of the origin", farthest, "check the unit of the file")


def _check_size(where: str, vertices_m: np.ndarray, expected_m: tuple[float, float]) -> None:
    size_m = float(np.ptp(vertices_m, axis=0).max())
    if not expected_m[0] <= size_m <= expected_m[1]:
        expected = f"a mesh {expected_m[0]:g} to {expected_m[1]:g} m long"
        raise BadInput(where, expected, f"{size_m:.3g} m", "check the unit of the mesh file")
