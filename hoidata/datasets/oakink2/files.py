"""OakInk2's files: annotations (a pickle of tensors and arrays), programs, names, the tree of parts. Nothing is run.

Its words: primitives of the programs as verbs, what the toolkit leaves unnamed, names of objects.
"""

import ast
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import orjson
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, HandType, Side
from hoidata.clips.hand_parameters import SourceHand
from hoidata.datasets import checks
from hoidata.errors import BadInput
from hoidata.files import load_torch_pickle

UNKNOWN = "?(unk)"
# Primitive -> verb, where it is not the primitive itself with blanks for underscores: the object is named by itself.
_VERBS = {
    "brush_whiteboard": "brush with",
    "cap_the_pen": "cap",
    "close_book": "close",
    "close_gate": "close",
    "close_laptop_lid": "close",
    "flip_close_tooth_paste_cap": "close",
    "flip_open_tooth_paste_cap": "open",
    "heat_beaker": "heat",
    "heat_test_tube": "heat",
    "hold_test_tube": "hold",
    "ignite_alcohol_lamp": "light",
    "insert_lightbulb": "insert",
    "insert_pencil": "insert",
    "insert_usb": "insert",
    "open_book": "open",
    "open_gate": "open",
    "open_laptop_lid": "open",
    "place_asbestos_mesh": "place",
    "place_inside": "put in",
    "place_on_test_tube_rack": "place",
    "place_onto": "place",
    "place_test_tube_on_rack_with_holder": "place",
    "plug_in_power_plug": "plug in",
    "pour_in_lab": "pour",
    "press_button": "press",
    "pull_out_drawer": "pull out",
    "push_in_drawer": "push in",
    "put_flower_into_vase": "put in",
    "put_off_alcohol_lamp": "put out",
    "put_on_lid": "put on",
    "remove_from_test_tube_rack": "remove",
    "remove_lid": "remove",
    "remove_lightbulb": "remove",
    "remove_pencil": "remove",
    "remove_power_plug": "remove",
    "remove_test_tube": "remove",
    "remove_test_tube_from_rack_with_holder": "remove",
    "remove_the_pen_cap": "uncap",
    "remove_usb": "remove",
    "shake_lab_container": "shake",
    "sharpen_pencil": "sharpen",
    "shear_paper": "cut with",
    "squeeze_tooth_paste": "squeeze",
    "staple_paper_together": "staple with",
    "stir_experiment_substances": "stir",
    "take_outside": "take out",
    "trigger_lever": "press",
    "uncap_alcohol_lamp": "uncap",
    "use_gamecontroller": "use",
    "use_keyboard": "use",
    "use_mouse": "use",
    "write_on_paper": "write with",
    "write_on_whiteboard": "write with",
}


def verb_of(primitive: str) -> str | None:
    """The verb of a primitive, None where the makers could not name it."""
    if primitive == UNKNOWN or not primitive.strip(" _"):
        return None
    return _VERBS.get(primitive, " ".join(primitive.replace("_", " ").split()).lower())


def noun_of(name: str) -> str:
    """A name of ``obj_desc.json`` as a noun without article."""
    return " ".join(name.replace("_", " ").split()).lower()


MOCAP_FPS = 120
STEP = MOCAP_FPS // FPS
LARGEST_JSON_BYTES = 4 << 20
PREFIXES: Mapping[Side, str] = {"left": "lh__", "right": "rh__"}
_LISTS = ("obj_list_lh", "obj_list_rh")
MODES = {"lh_main": _LISTS[:1], "rh_main": _LISTS[1:], "bh_main": _LISTS}  # the lists of the hands that do it
Range = tuple[int, int]
PART_ID = re.compile(r"\w[\w@-]{0,60}")
_KEY = re.compile(r"[\d\s(),\[\]None]{1,100}")
_MOST_GAPS = 10  # frame numbers may reach this much farther than there are frames
_LARGEST = 1e6
_LAST_FRAME = 10**7  # a day at 120 Hz


class Poses(NamedTuple):
    """One part on the annotation's frames: (frame, 4, 4) world from part, identity where it is not tracked (frame,)."""

    world_from_part: np.ndarray
    tracked: np.ndarray


class Annotation(NamedTuple):
    """30 of the 120 frames a second. frames: (frame,) mocap frame numbers, every fourth from the first one."""

    frames: np.ndarray
    parts: dict[str, Poses]
    hands: dict[Side, SourceHand]


class Segment(NamedTuple):
    """One primitive of a program. left, right: mocap frames (start, stop) of each hand, half-open, or None.

    objects: ids of the parts it is about, those of the hand that does it first.
    """

    left: Range | None
    right: Range | None
    primitive: str
    objects: tuple[str, ...]

    @property
    def span(self) -> Range:
        """From the first frame of either hand to the last."""
        starts, stops = zip(*(own for own in (self.left, self.right) if own), strict=True)
        return min(starts), max(stops)

    @property
    def hand(self) -> HandType:
        return "both" if self.left and self.right else "left" if self.left else "right"

    @property
    def name(self) -> str:
        """``left-1595-2340``, or both hands' ranges: no other primitive of the recording has it."""
        ranges = {"left": self.left, "right": self.right}
        return "-".join(f"{side}-{own[0]}-{own[1]}" for side, own in ranges.items() if own)


def read_annotation(data: bytes, where: str) -> Annotation:
    """Hands and parts of one recording, 30 frames a second. Raises BadInput."""
    content = load_torch_pickle(data, where, arrays=True)
    frames = _frames(f"{where}: mocap_frame_id_list", checks.entry(where, content, "mocap_frame_id_list"))
    ids, poses, mano = (checks.entry(where, content, name) for name in ("obj_list", "obj_transf", "raw_mano"))
    named = _part_ids(f"{where}: obj_list", ids)
    parts = {name: _poses(f"{where}: obj_transf[{name!r}]", poses[name], frames) for name in named if name in poses}
    hands: dict[Side, SourceHand] = {side: _hand(f"{where}: raw_mano", mano, side, frames) for side in SIDES}
    if not any(hand.valid is None or hand.valid.any() for hand in hands.values()):
        raise BadInput(f"{where}: raw_mano", "parameters of a hand in one frame or more", "none")
    return Annotation(frames, parts, hands)


def _frames(where: str, value: Any) -> np.ndarray:
    if not isinstance(value, list) or not all(isinstance(number, int | np.integer) for number in value):
        raise BadInput(where, "a list of frame numbers", repr(value)[:40])
    if not value or min(value) < 0 or max(value) > _LAST_FRAME:
        raise BadInput(where, f"frame numbers from 0 to {_LAST_FRAME}", repr(value[:3])[:40])
    numbers = np.array(value, dtype=np.int64)
    if (np.diff(numbers) <= 0).any() or np.ptp(numbers) > _MOST_GAPS * len(numbers):
        raise BadInput(where, "rising frame numbers without great gaps", f"{numbers[0]} to {numbers[-1]}")
    return np.arange(numbers[0], numbers[-1] + 1, STEP)


def _part_ids(where: str, value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(name, str) and PART_ID.fullmatch(name) for name in value):
        raise BadInput(where, "a list of part ids such as O02@0015@00001", repr(value)[:60])
    return list(dict.fromkeys(value))


def _poses(where: str, by_frame: Any, frames: np.ndarray) -> Poses:
    if not isinstance(by_frame, Mapping):
        raise BadInput(where, "a dictionary by frame number", type(by_frame).__name__)
    tracked = np.array([frame in by_frame for frame in frames.tolist()])
    found, poses = [by_frame[frame] for frame in frames[tracked].tolist()], np.tile(np.eye(4), (len(frames), 1, 1))
    if found:
        rows = _stacked(where, found, (4, 4))
        checks.rigid_transforms(where, [f"frame {frame}" for frame in frames[tracked]], rows)
        poses[tracked] = rows
    return Poses(poses, tracked)


def _stacked(where: str, values: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """(value, ...) float64 of arrays of one shape, which may have a leading axis of 1."""
    arrays = [np.asarray(value) if isinstance(value, np.ndarray) else np.zeros(0) for value in values]
    wrong = next((own for own in arrays if own.shape not in (shape, (1, *shape)) or own.dtype.kind != "f"), None)
    if wrong is not None:
        raise BadInput(where, f"arrays of shape {shape}", f"{wrong.dtype} of shape {wrong.shape}")
    rows = np.stack([own.reshape(shape) for own in arrays]).astype(np.float64)
    checks.finite(where, rows)
    if np.abs(rows).max() > _LARGEST:
        raise BadInput(where, f"metres and quaternions, at most {_LARGEST:g}", f"{np.abs(rows).max():.3g}")
    return rows


def _hand(where: str, by_frame: Any, side: Side, frames: np.ndarray) -> SourceHand:
    """Frames without an entry, or whose entry lacks this hand, are not valid."""
    if not isinstance(by_frame, Mapping):
        raise BadInput(where, "a dictionary by frame number", type(by_frame).__name__)
    names = [f"{PREFIXES[side]}{name}" for name in ("pose_coeffs", "tsl", "betas")]
    entries = [by_frame.get(frame) for frame in frames.tolist()]
    valid = np.array([isinstance(own, Mapping) and all(name in own for name in names) for own in entries])
    rows = [own for own in entries if isinstance(own, Mapping) and all(name in own for name in names)]
    values = [np.zeros((len(frames), columns)) for columns in (48, 3, 10)]
    if rows:
        quaternions, *others = (
            _stacked(f"{where}.{name}", [own[name] for own in rows], shape)
            for name, shape in zip(names, ((16, 4), (3,), (10,)), strict=True)
        )
        found = [_rotvecs(f"{where}.{names[0]}", quaternions, frames[valid]), *others]
        for whole, own in zip(values, found, strict=True):
            whole[valid] = own
    pose, translation_m, betas = values
    return SourceHand(translation_m, pose[:, :3], pose[:, 3:], betas, valid)


def _rotvecs(where: str, wxyz: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(frame, 48) axis-angles of quaternions (frame, 16, 4)."""
    off = np.abs(np.linalg.norm(wxyz, axis=-1) - 1).max(axis=1)
    if (off > 1e-2).any():
        first = int((off > 1e-2).argmax())
        raise BadInput(where, "unit quaternions w x y z", f"one off by {off[first]:.3g} in frame {frames[first]}")
    return Rotation.from_quat(wxyz.reshape(-1, 4), scalar_first=True).as_rotvec().reshape(-1, 48)


def read_program(data: bytes, where: str) -> list[Segment]:
    """The primitives of one recording in the order of the file. Raises BadInput."""
    program = _json(data, where)
    if not isinstance(program, Mapping):
        raise BadInput(where, "a dictionary of primitives by their ranges", type(program).__name__)
    found = [_segment(f"{where}: {key[:40]}", key, entry) for key, entry in program.items()]
    return list({segment.name: segment for segment in found}.values())


def _segment(where: str, key: str, entry: Any) -> Segment:
    primitive, mode = (checks.entry(where, entry, name) for name in ("primitive", "interaction_mode"))
    if not isinstance(primitive, str) or not isinstance(mode, str) or mode not in MODES:
        raise BadInput(where, f"a primitive, and a mode of {', '.join(MODES)}", f"{primitive!r}, {mode!r}"[:60])
    named = [checks.entry(where, entry, name) or [] for name in (*MODES[mode], "obj_list")]
    objects = [name for names in named for name in _part_ids(f"{where}: objects", names)]
    return Segment(*_ranges(where, key), primitive, tuple(dict.fromkeys(objects)))


def _ranges(where: str, key: str) -> tuple[Range | None, Range | None]:
    """The two ranges in a key such as ``((1595, 2340), None)``, left hand first."""
    try:
        value = ast.literal_eval(key.strip()) if _KEY.fullmatch(key) else None
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        value = None
    pair = [_range(own) for own in value] if isinstance(value, tuple | list) else []
    if len(pair) != 2 or pair == [None, None] or () in pair:
        raise BadInput(where, "a range of frames of each hand, or None, as ((1595, 2340), None)", repr(key)[:60])
    return pair[0] or None, pair[1] or None


def _range(value: Any) -> Range | tuple[()] | None:
    """None for None, an empty tuple for what is no range."""
    if value is None:
        return None
    whole = isinstance(value, tuple | list) and len(value) == 2 and all(type(number) is int for number in value)
    return (value[0], value[1]) if whole and 0 <= value[0] < value[1] <= _LAST_FRAME else ()


def read_names(data: bytes, where: str) -> dict[str, str]:
    """The name of each object or part by its id, of ``obj_desc.json``. Raises BadInput."""
    value = _json(data, where)
    if not isinstance(value, Mapping):
        raise BadInput(where, "a dictionary of objects by id", type(value).__name__)
    names = {key: checks.entry(f"{where}: {key[:40]}", entry, "obj_name") for key, entry in value.items()}
    wrong = next((key for key, name in names.items() if not isinstance(name, str)), None)
    if wrong is not None:
        raise BadInput(f"{where}: {wrong[:40]}", "a name in words", repr(names[wrong])[:40])
    return names


def read_roots(data: bytes, where: str) -> dict[str, str]:
    """The object each part belongs to, of ``object_part_tree.json``: id of the topmost node above it."""
    value = _json(data, where)
    if not isinstance(value, Mapping) or not all(
        isinstance(own, list) and all(isinstance(name, str) for name in own) for own in value.values()
    ):
        raise BadInput(where, "a dictionary of lists of part ids", repr(value)[:40])
    parent = {child: node for node, children in value.items() for child in children}
    topmost: dict[str, str] = {}
    for child in parent:
        path = dict[str, None]()  # up to a part whose topmost one is known, so that no step is made twice
        name: str = child
        while name in parent and name not in topmost:
            if name in path:
                raise BadInput(where, "a tree of parts", f"{name[:40]!r} below itself")
            path[name] = None
            name = parent[name]
        root: str = topmost.get(name, name)
        topmost |= {below: root for below in path}
    return topmost


def _json(data: bytes, where: str) -> Any:
    try:
        return orjson.loads(data)
    except ValueError as error:  # orjson.JSONDecodeError is one; text in another encoding too
        raise BadInput(where, "JSON", str(error)[:80]) from error
