"""HOT3D-Clips: 150 frames as a tar with JSON files of each, and images, which are not read; its own clock is 30 Hz."""

import io
import re
import tarfile
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.datasets import checks
from hoidata.datasets.hot3d.files import (
    LARGEST_JSON,
    HandFormat,
    Poses,
    checked_name,
    headset_of,
    poses_of,
    read_json,
    row_of,
)
from hoidata.errors import BadInput

SHAPES = "__hand_shapes.json__"
MEMBER = re.compile(r"([0-9]{6})\.(hands|objects)\.json|" + SHAPES)
STEP_NS = 1e9 / 30
MOST_MEMBERS = 2000  # a clip has 301
WRIST_NUMBERS = 6  # axis-angle, then place
COLUMNS = {"t_xyz": 3, "q_wxyz": 4}
Rows = dict[Any, list[tuple[int, list]]]


class Packed(NamedTuple):
    """hands: by format and side; objects and names: by the number of the benchmark; shapes: MANO's and UmeTrack's."""

    hands: dict[HandFormat, dict[Side, Poses]]
    objects: dict[str, Poses]
    names: dict[str, str]
    shapes: Any


def definition(data: bytes, where: str, number: int) -> tuple[str, str]:
    """The recording a clip is from, and its headset, of ``clip_definitions.json``."""
    about = checks.entry(where, read_json(data, where), str(number))
    recording = checks.entry(f"{where}: {number}", about, "sequence_id")
    if not isinstance(recording, str) or not re.fullmatch(r"P[0-9]{4}_[0-9a-f]+", recording):
        raise BadInput(f"{where}: {number}.sequence_id", "a recording such as P0003_c701bd11", repr(recording)[:40])
    return recording, headset_of(f"{where}: {number}", checks.entry(f"{where}: {number}", about, "device"))


def read_packed(data: bytes, where: str) -> Packed:
    """The JSON files of one clip. Raises BadInput where it has no hands or objects: of test clips they are withheld."""
    shapes: Any = {}
    hands: dict[HandFormat, Rows] = {"mano": {}, "umetrack": {}}
    objects: Rows = {}
    names: dict[str, str] = {}
    for name, content in _members(data, where):
        place, value = f"{where}/{name}", read_json(content, f"{where}/{name}")
        time_ns = round(int(name[:6]) * STEP_NS) if name != SHAPES else 0
        if name == SHAPES:
            shapes = value
        elif name.endswith("hands.json"):
            _add_hands(place, value, time_ns, hands)
        else:
            _add_objects(place, value, time_ns, objects, names)
    if not objects:
        raise BadInput(where, "poses of hands and objects", "none", "nothing to do: of test clips they are withheld")
    columns: dict[HandFormat, dict[str, int]] = {
        "mano": {**COLUMNS, "pose": 15},
        "umetrack": {**COLUMNS, "joint_angles": 20},
    }
    poses: dict[HandFormat, dict[Side, Poses]] = {
        kind: {side: poses_of(f"{where}: {side} hand", rows, columns[kind]) for side, rows in found.items()}
        for kind, found in hands.items()
    }
    placed = {key: poses_of(f"{where}: object {key}", rows, COLUMNS) for key, rows in sorted(objects.items())}
    return Packed(poses, placed, names, shapes)


def _members(data: bytes, where: str) -> Iterator[tuple[str, bytes]]:
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            wanted = (m for m in archive if MEMBER.fullmatch(m.name) and m.isfile() and m.size <= LARGEST_JSON)
            for number, member in enumerate(wanted):
                if number > MOST_MEMBERS:
                    raise BadInput(where, f"at most {MOST_MEMBERS} JSON files", "more")
                stream = archive.extractfile(member)
                yield member.name, stream.read() if stream else b""
    except (tarfile.TarError, OSError, EOFError, ValueError, OverflowError) as error:
        raise BadInput(where, "a whole .tar archive", f"{type(error).__name__}: {str(error)[:80]}") from error


def _add_hands(where: str, value: Any, time_ns: int, hands: Mapping[HandFormat, Rows]) -> None:
    """A side that is null or not there was not tracked; MANO may be missing where UmeTrack is there."""
    for side in SIDES:
        hand = value.get(side) if isinstance(value, dict) else checks.entry(where, value, side)
        if hand is None:
            continue
        place = f"{where}: {side}"
        if isinstance(hand, dict) and "mano_pose" in hand:
            orient_and_place = row_of(f"{place}.mano_pose", hand["mano_pose"], "wrist_xform", WRIST_NUMBERS)
            turn = np.roll(Rotation.from_rotvec(np.clip(orient_and_place[:3], -100, 100)).as_quat(), 1).tolist()
            pose = row_of(f"{place}.mano_pose", hand["mano_pose"], "thetas", 15)
            hands["mano"].setdefault(side, []).append((time_ns, [*orient_and_place[3:], *turn, *pose]))
        own = checks.entry(place, hand, "umetrack_pose")
        angles = row_of(f"{place}.umetrack_pose", own, "joint_angles", 20)
        placed = _placed(f"{place}.umetrack_pose", checks.entry(place, own, "T_world_from_wrist"))
        hands["umetrack"].setdefault(side, []).append((time_ns, [*placed, *angles]))


def _add_objects(where: str, value: Any, time_ns: int, objects: Rows, names: dict[str, str]) -> None:
    if not isinstance(value, dict):
        raise BadInput(where, "a dictionary of objects by number", type(value).__name__)
    for key, things in value.items():
        if not re.fullmatch(r"[0-9]{1,6}", key) or not isinstance(things, list) or len(things) != 1:
            raise BadInput(f"{where}: {key}", "a number, and one object in a list", repr(things)[:40])
        place = _placed(f"{where}: {key}", checks.entry(f"{where}: {key}", things[0], "T_world_from_object"))
        objects.setdefault(key, []).append((time_ns, place))
        names[key] = checked_name(f"{where}: {key}", checks.entry(f"{where}: {key}", things[0], "object_name"))


def _placed(where: str, value: Any) -> list:
    return [*row_of(where, value, "translation_xyz", 3), *row_of(where, value, "quaternion_wxyz", 4)]
