"""Readers of OakInk2's files: annotations (pickled tensors, loaded without code), programs, names, the tree of parts.

Also the words: verbs of the programs' primitives and names of objects.
"""

import ast
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, HandType, Side
from hoidata.clips.hand_parameters import SourceHand
from hoidata.datasets import checks
from hoidata.errors import BadInput
from hoidata.files import load_torch_pickle

UNKNOWN = "?(unk)"
# Verbs of primitives that differ from the primitive's words, because the sentence names the object separately.
_VERBS = {primitive: verb for verb, primitives in {
    "brush with": "brush_whiteboard",
    "cap": "cap_the_pen",
    "close": "close_book close_gate close_laptop_lid flip_close_tooth_paste_cap",
    "cut with": "shear_paper",
    "heat": "heat_beaker heat_test_tube",
    "hold": "hold_test_tube",
    "insert": "insert_lightbulb insert_pencil insert_usb",
    "light": "ignite_alcohol_lamp",
    "open": "flip_open_tooth_paste_cap open_book open_gate open_laptop_lid",
    "place": "place_asbestos_mesh place_on_test_tube_rack place_onto place_test_tube_on_rack_with_holder",
    "plug in": "plug_in_power_plug",
    "pour": "pour_in_lab",
    "press": "press_button trigger_lever",
    "pull out": "pull_out_drawer",
    "push in": "push_in_drawer",
    "put in": "place_inside put_flower_into_vase",
    "put on": "put_on_lid",
    "put out": "put_off_alcohol_lamp",
    "remove": "remove_from_test_tube_rack remove_lid remove_lightbulb remove_pencil remove_power_plug remove_test_tube "
              "remove_test_tube_from_rack_with_holder remove_usb",
    "shake": "shake_lab_container",
    "sharpen": "sharpen_pencil",
    "squeeze": "squeeze_tooth_paste",
    "staple with": "staple_paper_together",
    "stir": "stir_experiment_substances",
    "take out": "take_outside",
    "uncap": "remove_the_pen_cap uncap_alcohol_lamp",
    "use": "use_gamecontroller use_keyboard use_mouse",
    "write with": "write_on_paper write_on_whiteboard",
}.items() for primitive in primitives.split()}  # fmt: skip


def verb_of(primitive: str) -> str | None:
    """The verb of a primitive; None if the authors did not name it."""
    if primitive == UNKNOWN or not primitive.strip(" _"):
        return None
    return _VERBS.get(primitive, " ".join(primitive.replace("_", " ").split()).lower())


def noun_of(name: str) -> str:
    """A name of ``obj_desc.json`` as a noun without article."""
    return " ".join(name.replace("_", " ").split()).lower()


MOCAP_FPS = 120
STEP = MOCAP_FPS // FPS
MAX_JSON_BYTES = 4 << 20
PREFIXES: Mapping[Side, str] = {"left": "lh__", "right": "rh__"}
_LISTS = ("obj_list_lh", "obj_list_rh")
MODES = {"lh_main": _LISTS[:1], "rh_main": _LISTS[1:], "bh_main": _LISTS}  # object lists of the leading hands
Range = tuple[int, int]
PART_ID = re.compile(r"\w[\w@-]{0,60}")
_KEY = re.compile(r"[\d\s(),\[\]None]{1,100}")
_MAX_GAP_RATIO = 10  # largest ratio of the range of frame numbers to their count
_MAX_VALUE = 1e6
_MAX_FRAME = 10**7  # a day at 120 Hz


class Poses(NamedTuple):
    """Poses of one part on the annotation's frames."""

    world_from_part: np.ndarray  # (frame, 4, 4), identity in untracked frames
    tracked: np.ndarray  # (frame,) bool


class Annotation(NamedTuple):
    """Hands and parts of one recording at 30 fps."""

    frames: np.ndarray  # (frame,) frame numbers at 120 Hz, every fourth from the first
    parts: dict[str, Poses]  # by part id
    hands: dict[Side, SourceHand]


class Segment(NamedTuple):
    """One primitive of a program, or an object over the whole recording."""

    left: Range | None  # frames at 120 Hz of the left hand, half-open; None if it is not involved
    right: Range | None
    primitive: str | None  # None: the whole recording
    objects: tuple[str, ...]  # ids of the parts involved, the leading hand's first

    @property
    def verb(self) -> str | None:
        """None if the source does not state it."""
        return None if self.primitive is None else verb_of(self.primitive)

    @property
    def span(self) -> Range:
        """The range that covers both hands."""
        starts, stops = zip(*(hand_range for hand_range in (self.left, self.right) if hand_range), strict=True)
        return min(starts), max(stops)

    @property
    def hand(self) -> HandType | None:
        """The hands that are involved; None if the source does not state them."""
        if self.primitive is None:
            return None
        return "both" if self.left and self.right else "left" if self.left else "right"

    @property
    def name(self) -> str:
        """Unique name in the recording: ``left-1595-2340``, both hands' ranges, or the object."""
        if self.primitive is None:
            return self.objects[0]
        ranges = {"left": self.left, "right": self.right}
        return "-".join(f"{side}-{hand_range[0]}-{hand_range[1]}" for side, hand_range in ranges.items() if hand_range)


def read_annotation(data: bytes, path: str) -> Annotation:
    """Read hands and parts of one recording at 30 fps. Raises BadInput."""
    content = load_torch_pickle(data, path, arrays=True)
    frames = _frames(f"{path}: mocap_frame_id_list", checks.entry(path, content, "mocap_frame_id_list"))
    ids, poses, mano = (checks.entry(path, content, name) for name in ("obj_list", "obj_transf", "raw_mano"))
    part_ids = _part_ids(f"{path}: obj_list", ids)
    parts = {name: _poses(f"{path}: obj_transf[{name!r}]", poses[name], frames) for name in part_ids if name in poses}
    hands: dict[Side, SourceHand] = {side: _hand(f"{path}: raw_mano", mano, side, frames) for side in SIDES}
    if not any(hand.valid is None or hand.valid.any() for hand in hands.values()):
        raise BadInput(f"{path}: raw_mano", "parameters of a hand in one frame or more", "none")
    return Annotation(frames, parts, hands)


def _frames(location: str, value: Any) -> np.ndarray:
    if not isinstance(value, list) or not all(isinstance(number, int | np.integer) for number in value):
        raise BadInput(location, "a list of frame numbers", repr(value)[:40])
    if not value or min(value) < 0 or max(value) > _MAX_FRAME:
        raise BadInput(location, f"frame numbers from 0 to {_MAX_FRAME}", repr(value[:3])[:40])
    numbers = np.array(value, dtype=np.int64)
    if (np.diff(numbers) <= 0).any() or np.ptp(numbers) > _MAX_GAP_RATIO * len(numbers):
        raise BadInput(location, "rising frame numbers without great gaps", f"{numbers[0]} to {numbers[-1]}")
    return np.arange(numbers[0], numbers[-1] + 1, STEP)


def _part_ids(location: str, value: Any) -> list[str]:
    if not isinstance(value, list) or not all(isinstance(name, str) and PART_ID.fullmatch(name) for name in value):
        raise BadInput(location, "a list of part ids such as O02@0015@00001", repr(value)[:60])
    return list(dict.fromkeys(value))


def _poses(location: str, by_frame: Any, frames: np.ndarray) -> Poses:
    if not isinstance(by_frame, Mapping):
        raise BadInput(location, "a dictionary by frame number", type(by_frame).__name__)
    tracked = np.array([frame in by_frame for frame in frames.tolist()])
    matrices, poses = [by_frame[frame] for frame in frames[tracked].tolist()], np.tile(np.eye(4), (len(frames), 1, 1))
    if matrices:
        rows = _stack_arrays(location, matrices, (4, 4))
        checks.rigid_transforms(location, [f"frame {frame}" for frame in frames[tracked]], rows)
        poses[tracked] = rows
    return Poses(poses, tracked)


def _stack_arrays(location: str, values: list[Any], shape: tuple[int, ...]) -> np.ndarray:
    """Stack arrays of one shape, or of that shape with a leading axis of 1, to (value, ...) float64."""
    arrays = [np.asarray(value) if isinstance(value, np.ndarray) else np.zeros(0) for value in values]
    shapes = (shape, (1, *shape))
    wrong = next((array for array in arrays if array.shape not in shapes or array.dtype.kind != "f"), None)
    if wrong is not None:
        raise BadInput(location, f"arrays of shape {shape}", f"{wrong.dtype} of shape {wrong.shape}")
    rows = np.stack([array.reshape(shape) for array in arrays]).astype(np.float64)
    checks.finite(location, rows)
    if np.abs(rows).max() > _MAX_VALUE:
        raise BadInput(location, f"metres and quaternions, at most {_MAX_VALUE:g}", f"{np.abs(rows).max():.3g}")
    return rows


def _hand(location: str, by_frame: Any, side: Side, frames: np.ndarray) -> SourceHand:
    """The parameters of one hand. Frames whose entry is missing or lacks this hand are invalid."""
    if not isinstance(by_frame, Mapping):
        raise BadInput(location, "a dictionary by frame number", type(by_frame).__name__)
    names = [f"{PREFIXES[side]}{name}" for name in ("pose_coeffs", "tsl", "betas")]
    entries = [by_frame.get(frame) for frame in frames.tolist()]
    valid = np.array([isinstance(entry, Mapping) and all(name in entry for name in names) for entry in entries])
    valid_entries = [entry for entry in entries if isinstance(entry, Mapping) and all(name in entry for name in names)]
    values = [np.zeros((len(frames), columns)) for columns in (48, 3, 10)]
    if valid_entries:
        quaternions, *others = (
            _stack_arrays(f"{location}.{name}", [entry[name] for entry in valid_entries], shape)
            for name, shape in zip(names, ((16, 4), (3,), (10,)), strict=True)
        )
        arrays = [_rotvecs(f"{location}.{names[0]}", quaternions, frames[valid]), *others]
        for value, array in zip(values, arrays, strict=True):
            value[valid] = array
    pose, translation_m, betas = values
    return SourceHand(translation_m, pose[:, :3], pose[:, 3:], betas, valid=valid)


def _rotvecs(location: str, wxyz: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(frame, 48) axis-angles of quaternions (frame, 16, 4)."""
    norm_error = np.abs(np.linalg.norm(wxyz, axis=-1) - 1).max(axis=1)
    if (norm_error > 1e-2).any():
        first = int((norm_error > 1e-2).argmax())
        got = f"one off by {norm_error[first]:.3g} in frame {frames[first]}"
        raise BadInput(location, "unit quaternions w x y z", got)
    return Rotation.from_quat(wxyz.reshape(-1, 4), scalar_first=True).as_rotvec().reshape(-1, 48)


def read_program(data: bytes, path: str) -> list[Segment]:
    """Read the primitives of one recording in the order of the file. Raises BadInput."""
    program = checks.json_value(path, data)
    if not isinstance(program, Mapping):
        raise BadInput(path, "a dictionary of primitives by their ranges", type(program).__name__)
    segments = [_segment(f"{path}: {key[:40]}", key, entry) for key, entry in program.items()]
    return list({segment.name: segment for segment in segments}.values())


def _segment(location: str, key: str, entry: Any) -> Segment:
    primitive, mode = (checks.entry(location, entry, name) for name in ("primitive", "interaction_mode"))
    if not isinstance(primitive, str) or not isinstance(mode, str) or mode not in MODES:
        raise BadInput(location, f"a primitive, and a mode of {', '.join(MODES)}", f"{primitive!r}, {mode!r}"[:60])
    id_lists = [checks.entry(location, entry, name) or [] for name in (*MODES[mode], "obj_list")]
    objects = [name for names in id_lists for name in _part_ids(f"{location}: objects", names)]
    left, right = _ranges(location, key)
    return Segment(left=left, right=right, primitive=primitive, objects=tuple(dict.fromkeys(objects)))


def _ranges(location: str, key: str) -> tuple[Range | None, Range | None]:
    """The two ranges in a key such as ``((1595, 2340), None)``, left hand first."""
    try:
        value = ast.literal_eval(key.strip()) if _KEY.fullmatch(key) else None
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        value = None
    pair = [_range(item) for item in value] if isinstance(value, tuple | list) else []
    if len(pair) != 2 or pair == [None, None] or () in pair:
        raise BadInput(location, "a range of frames of each hand, or None, as ((1595, 2340), None)", repr(key)[:60])
    return pair[0] or None, pair[1] or None


def _range(value: Any) -> Range | tuple[()] | None:
    """Parse one range. Returns None for None and an empty tuple for an invalid range."""
    if value is None:
        return None
    is_pair = isinstance(value, tuple | list) and len(value) == 2 and all(type(number) is int for number in value)
    return (value[0], value[1]) if is_pair and 0 <= value[0] < value[1] <= _MAX_FRAME else ()


def read_names(data: bytes, path: str) -> dict[str, str]:
    """Read ``obj_desc.json``: names by id of object or part. Raises BadInput."""
    value = checks.json_value(path, data)
    if not isinstance(value, Mapping):
        raise BadInput(path, "a dictionary of objects by id", type(value).__name__)
    names = {key: checks.entry(f"{path}: {key[:40]}", entry, "obj_name") for key, entry in value.items()}
    unnamed = next((key for key, name in names.items() if not isinstance(name, str)), None)
    if unnamed is not None:
        raise BadInput(f"{path}: {unnamed[:40]}", "a name in words", repr(names[unnamed])[:40])
    return names


def read_roots(data: bytes, location: str) -> dict[str, str]:
    """Read ``object_part_tree.json``: id of the root node by part id. Raises BadInput."""
    value = checks.json_value(location, data)
    lists = list(value.values()) if isinstance(value, Mapping) else [None]
    if not all(isinstance(names, list) and all(isinstance(name, str) for name in names) for names in lists):
        raise BadInput(location, "a dictionary of lists of part ids", repr(value)[:40])
    parent = {child: node for node, children in value.items() for child in children}
    topmost: dict[str, str] = {}
    for child in parent:
        path = dict[str, None]()  # nodes visited up to a node whose root is known
        name: str = child
        while name in parent and name not in topmost:
            if name in path:
                raise BadInput(location, "a tree of parts", f"{name[:40]!r} below itself")
            path[name] = None
            name = parent[name]
        root: str = topmost.get(name, name)
        topmost |= {below: root for below in path}
    return topmost
