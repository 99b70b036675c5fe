"""What ARCTIC's small files say: descriptions, part ids, image offsets and the head camera (Fan et al. 2023).

Also its objects in words, the verbs of Text2HOI's descriptions, and the pairs that Text2HOI leaves out.

The ``parse_`` functions take the bytes of a file and open nothing.
"""

import re
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import orjson

from hoidata.clips.clip import CameraTrack, HandType
from hoidata.datasets import checks
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec

EXCLUDED = {("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")}  # as Text2HOI does
OBJECT_WORDS = {
    "capsulemachine": "capsule machine",
    "espressomachine": "espresso machine",
    "waffleiron": "waffle iron",
}
OBJECTS = ("box", "capsulemachine", "espressomachine", "ketchup", "laptop", "microwave", "mixer", "notebook", "phone",
           "scissors", "waffleiron")  # fmt: skip
VERBS = ("close", "cut", "grasp", "lift", "open", "operate", "place", "point", "shake", "sprinkle", "type")


def object_words(name: str) -> str:
    """ARCTIC's joined object name in words; other names stay."""
    return OBJECT_WORDS.get(name, name)


# Every verb with every object but for those that only some objects can be used for.
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
    """One line of a description file: frames ``start`` to ``stop`` counted from 1, both included."""

    start: int
    stop: int
    verb: str
    hand: HandType


def parse_description(line: str) -> Description:
    """``12-100 grab, right hand``: range from 1, verb, hand, a fourth word that means nothing. Raises ValueError."""
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


def parse_descriptions(data: bytes, where: str) -> tuple[list[Description], list[tuple[int, BadInput]]]:
    """The lines of a description file, and the bad ones by number (from 1) with what is wrong. Blank ones mean nothing.

    Raises BadInput for anything that is not text of at most 16 MB.
    """
    described: list[Description] = []
    problems: list[tuple[int, BadInput]] = []
    for number, line in enumerate(_text(data, where).splitlines(), 1):
        if not line.strip():
            continue
        try:
            described.append(parse_description(line))
        except ValueError as error:
            expected = "'<start>-<end> <action>, <left|right|both> hand'"
            problems.append((number, BadInput(f"{where}:{number}", expected, str(error)[:80], "mend the line")))
    return described, problems


def parse_parts(data: bytes, where: str, n_vertices: int) -> np.ndarray:
    """(vertex,) bool, True for the base. In the file 0 (false) is the top, which moves; ARCTIC's docs have it wrong.

    Raises BadInput unless it is a JSON list of so many zeros and ones (or booleans).
    """
    values = _json(data, where, "a JSON list")
    if not isinstance(values, list) or len(values) != n_vertices or any(value not in (0, 1) for value in values):
        got = f"a list of {len(values)}" if isinstance(values, list) else type(values).__name__
        raise BadInput(where, f"a list of {n_vertices} zeros and ones, one per vertex of mesh.obj", got)
    return np.array(values, dtype=bool)


def parse_misc(data: bytes, where: str) -> dict[str, int]:
    """``ioi_offset`` of each subject: the number of a frame's image is the frame plus this. Raises BadInput."""
    subjects = _json(data, where, "a JSON object with an entry per subject")
    if not isinstance(subjects, dict):
        raise BadInput(where, "a JSON object with an entry per subject", type(subjects).__name__)
    offsets = {}
    for subject, facts in subjects.items():
        offset = checks.entry(f"{where}: {subject}", facts, "ioi_offset")
        if isinstance(offset, bool) or not isinstance(offset, int) or abs(offset) > 1_000_000:
            raise BadInput(f"{where}: {subject}.ioi_offset", "a whole number of frames", repr(offset)[:40])
        offsets[subject] = offset
    return offsets


def head_camera(where: str, content: Any, n_frames: int, image_offset: int) -> CameraTrack:
    """The camera on the subject's head. The file takes world points to the camera (``R x + T``); a clip the other way.

    image_offset: images are numbered so many later than frames.
    """
    rotation = _matrices(f"{where}: R_k_cam_np", checks.entry(where, content, "R_k_cam_np"), n_frames)
    shift = np.asarray(checks.entry(where, content, "T_k_cam_np"))
    shift = shift[..., 0] if shift.ndim == 3 and shift.shape[2] == 1 else shift
    shift = checks.table(f"{where}: T_k_cam_np", shift, 3, n_frames)
    matrix = checks.table(f"{where}: intrinsics", checks.entry(where, content, "intrinsics"), 3, 3, "rows")
    world_from_camera = rotation.transpose(0, 2, 1)
    return CameraTrack(
        name="ego",
        rotvec=rotmat_to_rotvec(world_from_camera).astype(np.float32),
        position_m=-(world_from_camera @ shift[..., None])[..., 0].astype(np.float32),
        images=np.arange(n_frames, dtype=np.int32) + np.int32(image_offset),
        intrinsics=np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *EGO_IMAGE_SIZE]),
    )


def _matrices(where: str, value: Any, n_frames: int) -> np.ndarray:
    """Proper rotations (frame, 3, 3)."""
    matrices = np.asarray(value)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
        raise BadInput(where, "a 3 x 3 matrix per frame", f"shape {matrices.shape}")
    matrices = checks.table(where, matrices.reshape(-1, 9), 9, n_frames).reshape(-1, 3, 3)
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (error > _ROTATION_ERROR) | (np.linalg.det(matrices) < 0)
    if bad.any():
        first = int(bad.argmax())
        got = f"one off by {error[first]:.3g}" if error[first] > _ROTATION_ERROR else "a mirror"
        raise BadInput(where, "rotations", f"{got} in row {first}")
    return matrices


def _json(data: bytes, where: str, expected: str) -> Any:
    try:
        return orjson.loads(_checked(data, where))
    except orjson.JSONDecodeError as error:
        raise BadInput(where, expected, str(error)) from error


def _text(data: bytes, where: str) -> str:
    try:
        return _checked(data, where).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(where, "UTF-8 text", str(error)) from error


def _checked(data: bytes, where: str) -> bytes:
    if len(data) > LARGEST_TEXT_BYTES:
        raise BadInput(where, f"at most {LARGEST_TEXT_BYTES} bytes", f"{len(data)}")
    return data
