"""Parsers of ARCTIC's small files: descriptions, part ids, image offsets and the head camera (Fan et al. 2023).

Also its objects in words, the verbs of Text2HOI's descriptions, and the pairs that Text2HOI excludes.

The ``parse_`` functions take the bytes of a file.
"""

import re
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from hoidata.clips.clip import CameraTrack, HandType
from hoidata.datasets import checks
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec

EXCLUDED = {("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")}  # as in Text2HOI
OBJECT_WORDS = {
    "capsulemachine": "capsule machine",
    "espressomachine": "espresso machine",
    "waffleiron": "waffle iron",
}
OBJECTS = ("box", "capsulemachine", "espressomachine", "ketchup", "laptop", "microwave", "mixer", "notebook", "phone",
           "scissors", "waffleiron")  # fmt: skip
VERBS = ("close", "cut", "grasp", "lift", "open", "operate", "place", "point", "shake", "sprinkle", "type")


def object_words(name: str) -> str:
    """ARCTIC's joined object name in words; other names are unchanged."""
    return OBJECT_WORDS.get(name, name)


# All pairs of verb and object, except verbs that apply to some objects only.
_ONLY = {"cut": ("scissors",), "sprinkle": ("ketchup",), "type": ("laptop", "phone")}
PAIRS = tuple(
    (verb, object_words(name))
    for verb in VERBS
    for name in OBJECTS
    if (verb, name) not in EXCLUDED and name in _ONLY.get(verb, OBJECTS)
)


LARGEST_TEXT_BYTES = 4 << 20
EGO_IMAGE_SIZE = (2800, 2000)  # width, height of the head camera's images
_RANGE = re.compile(r"([0-9]{1,9})-([0-9]{1,9})")
_ROTATION_ERROR = 1e-3


@dataclass(frozen=True)
class Description:
    """One line of a description file."""

    start: int  # first frame, counted from 1
    stop: int  # last frame, inclusive
    verb: str
    hand: HandType


def parse_description(line: str) -> Description:
    """Parse ``12-100 grab, right hand``: range from 1, verb, hand and an ignored fourth word. Raises ValueError."""
    words = line.split()
    if len(words) != 4:
        raise ValueError(f"{len(words)} words")
    ends = _RANGE.fullmatch(words[0])
    if ends is None or not 1 <= int(ends[1]) <= int(ends[2]):
        raise ValueError(f"the range {words[0]!r}")
    if words[2] not in get_args(HandType):
        raise ValueError(f"the hand {words[2]!r}")
    verb = words[1].rstrip(",")
    if not verb:
        raise ValueError("no verb")
    return Description(int(ends[1]), int(ends[2]), verb, words[2])  # type: ignore[arg-type]


def parse_descriptions(data: bytes, path: str) -> tuple[list[Description], list[tuple[int, BadInput]]]:
    """Parse a description file and ignore blank lines. Raises BadInput unless it is UTF-8 text of at most 4 MiB.

    Returns:
        The valid lines, and the number (from 1) and problem of each malformed line.
    """
    described: list[Description] = []
    problems: list[tuple[int, BadInput]] = []
    for number, line in enumerate(_text(data, path).splitlines(), 1):
        if not line.strip():
            continue
        try:
            described.append(parse_description(line))
        except ValueError as error:
            expected = "'<start>-<end> <action>, <left|right|both> hand'"
            problems.append((number, BadInput(f"{path}:{number}", expected, str(error)[:80], "mend the line")))
    return described, problems


def parse_parts(data: bytes, path: str, n_vertices: int) -> np.ndarray:
    """Parse parts.json to (vertex,) bool, True for the base. In the file 0 is the top, which moves.

    ARCTIC's documentation states the opposite. Raises BadInput unless the file is a JSON list of ``n_vertices`` zeros
    and ones or booleans.
    """
    values = checks.json_value(path, _checked(data, path))
    if not isinstance(values, list) or len(values) != n_vertices or any(value not in (0, 1) for value in values):
        got = f"a list of {len(values)}" if isinstance(values, list) else type(values).__name__
        raise BadInput(path, f"a list of {n_vertices} zeros and ones, one per vertex of mesh.obj", got)
    return np.array(values, dtype=bool)


def parse_misc(data: bytes, path: str) -> dict[str, int]:
    """``ioi_offset`` of each subject: image number minus frame number. Raises BadInput."""
    subjects = checks.json_value(path, _checked(data, path))
    if not isinstance(subjects, dict):
        raise BadInput(path, "a JSON object with an entry per subject", type(subjects).__name__)
    offsets = {}
    for subject, entry in subjects.items():
        offset = checks.entry(f"{path}: {subject}", entry, "ioi_offset")
        if isinstance(offset, bool) or not isinstance(offset, int) or abs(offset) > 1_000_000:
            raise BadInput(f"{path}: {subject}.ioi_offset", "a whole number of frames", repr(offset)[:40])
        offsets[subject] = offset
    return offsets


def head_camera(location: str, content: Any, n_frames: int, image_offset: int) -> CameraTrack:
    """Convert the head camera: the file has camera from world (``R x + T``), a clip has world from camera.

    Args:
        location: file, for errors.
        content: of the file.
        n_frames: required number of frames.
        image_offset: image number minus frame number.
    """
    rotation = _matrices(f"{location}: R_k_cam_np", checks.entry(location, content, "R_k_cam_np"), n_frames)
    translation = np.asarray(checks.entry(location, content, "T_k_cam_np"))
    translation = translation[..., 0] if translation.ndim == 3 and translation.shape[2] == 1 else translation
    translation = checks.table(f"{location}: T_k_cam_np", translation, 3, n_frames)
    matrix = checks.table(f"{location}: intrinsics", checks.entry(location, content, "intrinsics"), 3, 3, "rows")
    world_from_camera = rotation.transpose(0, 2, 1)
    return CameraTrack(
        name="ego",
        rotvec=rotmat_to_rotvec(world_from_camera).astype(np.float32),
        position_m=-(world_from_camera @ translation[..., None])[..., 0].astype(np.float32),
        images=np.arange(n_frames, dtype=np.int32) + np.int32(image_offset),
        intrinsics=np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *EGO_IMAGE_SIZE]),
    )


def _matrices(location: str, value: Any, n_frames: int) -> np.ndarray:
    """Check and return proper rotations (frame, 3, 3)."""
    matrices = np.asarray(value)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
        raise BadInput(location, "a 3 x 3 matrix per frame", f"shape {matrices.shape}")
    matrices = checks.table(location, matrices.reshape(-1, 9), 9, n_frames).reshape(-1, 3, 3)
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (error > _ROTATION_ERROR) | (np.linalg.det(matrices) < 0)
    if bad.any():
        first = int(bad.argmax())
        got = f"one off by {error[first]:.3g}" if error[first] > _ROTATION_ERROR else "a mirror"
        raise BadInput(location, "rotations", f"{got} in row {first}")
    return matrices


def _text(data: bytes, path: str) -> str:
    try:
        return _checked(data, path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(path, "UTF-8 text", str(error)) from error


def _checked(data: bytes, path: str) -> bytes:
    if len(data) > LARGEST_TEXT_BYTES:
        raise BadInput(path, f"at most {LARGEST_TEXT_BYTES} bytes", f"{len(data)}")
    return data
