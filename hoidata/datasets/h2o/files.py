"""Readers of H2O's text files: one line of numbers per frame file, and lists of segments in label_split; and its hands.

Class ids, action labels and layouts follow the dataset's README (Kwon et al. 2021), except that a hand's MANO block has
62 numbers and not 59. Hands are MANO parameters, or fitted to the 21 joints, which needs no MANO file.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import orjson

from hoidata.clips.clip import SIDES, HandTrack, Side
from hoidata.clips.hand_parameters import FrameChange, HandConvention, SourceHand, hand_track, to_track
from hoidata.datasets import checks
from hoidata.datasets.base import RawTree
from hoidata.datasets.gravity import hand_joints_m
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair
from hoidata.hands.fitting import fit_hands, fit_shape
from hoidata.hands.model import openpose_to_mano_order

OBJECTS = ("", "book", "espresso", "lotion", "spray", "milk", "cocoa", "chips", "cappuccino")  # by class id
_SHELF = OBJECTS[1:]
ACTIONS: tuple[tuple[str, str], ...] = (  # (verb, object) by action label; 0 is background
    ("", ""),
    *(("grab", noun) for noun in _SHELF),
    *(("place", noun) for noun in _SHELF),
    *(("open", noun) for noun in ("lotion", "milk", "chips")),
    *(("close", noun) for noun in ("lotion", "milk", "chips")),
    ("pour", "milk"),
    *(("take out", noun) for noun in ("espresso", "cocoa", "chips", "cappuccino")),
    *(("put in", noun) for noun in ("espresso", "cocoa", "cappuccino")),
    *(("apply", noun) for noun in ("lotion", "spray")),
    *(("read", noun) for noun in ("book", "espresso")),
    ("spray", "spray"),
    ("squeeze", "lotion"),
)
PAIRS = ACTIONS[1:]


HandSource = Literal["mano", "keypoints"]
HAND_FOLDERS: dict[HandSource, tuple[str, int]] = {"mano": ("hand_pose_mano", 124), "keypoints": ("hand_pose", 128)}
LISTS = "label_split"
INTRINSICS = "cam_intrinsics.txt"
_FRAME_FILE = re.compile(r"\d{6}\.txt")
_LIST_FILE = re.compile(r"action_\w+\.txt")
_SEQUENCE = re.compile(r"subject\d+/\w+/\d+")
_LIST_COLUMNS = ("id", "path", "action_label", "start_act", "end_act", "start_frame", "end_frame")
_LARGEST_LIST = 4 << 20  # bytes; the released ones have some 50,000
_LONGEST_NUMBER = 9  # digits of a frame number that is one


@dataclass(frozen=True)
class SequenceFrames:
    """The numbers of one sequence as in the files (camera frame, metres)."""

    folder: str  # of the camera
    first: int  # number of the first frame
    camera: np.ndarray  # (frame, 4, 4) world from camera
    hands: np.ndarray  # (frame, 124) of hand_pose_mano or (frame, 128) of hand_pose
    classes: np.ndarray  # (frame,) int class of the tracked object, 0 for none
    objects: np.ndarray  # (frame, 4, 4) camera from object
    label: np.ndarray | None  # (frame,) int action; None if labels are withheld
    intrinsics: np.ndarray | None  # (6,)

    def __len__(self) -> int:
        return len(self.classes)


class Segment(NamedTuple):
    """One row of a segment list."""

    sequence: str
    label: int | None  # action; None if it is withheld
    start: int  # first frame of the action
    last: int  # last frame of the action, inclusive


def read_frames(raw: RawTree, folder: str, hands: HandSource) -> SequenceFrames:
    """Read all frame files of one camera's folder. Raises BadInput that names a missing or unusable file."""
    hand_folder, hand_columns = HAND_FOLDERS[hands]
    kinds = {kind: _folder_of(raw, folder, kind) for kind in ("cam_pose", hand_folder, "obj_pose_rt", "action_label")}
    labelled = bool(_frame_files(raw, kinds["action_label"]))
    _refuse_other_hands(raw, folder, kinds[hand_folder], hands)
    files = _common_files(raw, [path for kind, path in kinds.items() if labelled or kind != "action_label"])
    camera = _read(raw, kinds["cam_pose"], files, 16).reshape(-1, 4, 4)
    objects = _read(raw, kinds["obj_pose_rt"], files, 17)
    hand_numbers = _read(raw, kinds[hand_folder], files, hand_columns)
    _check_ids(kinds["obj_pose_rt"], files, objects[:, 0], len(OBJECTS))
    checks.rigid_transforms(kinds["cam_pose"], files, camera)
    tracked = np.flatnonzero(objects[:, 0])
    poses = objects[:, 1:].reshape(-1, 4, 4)
    checks.rigid_transforms(kinds["obj_pose_rt"], [files[frame] for frame in tracked], poses[tracked])
    label = _read(raw, kinds["action_label"], files, 1)[:, 0] if labelled else None
    if label is not None:
        _check_ids(kinds["action_label"], files, label, len(ACTIONS))
    lens = f"{folder}/{INTRINSICS}"
    return SequenceFrames(
        folder=folder,
        first=int(files[0][:6]),
        camera=camera,
        hands=hand_numbers,
        classes=objects[:, 0].astype(int),
        objects=poses,
        label=None if label is None else label.astype(int),
        intrinsics=parse_rows([raw.read(lens)], 6, folder, [INTRINSICS])[0] if raw.has(lens) else None,
    )


def parse_rows(contents: Sequence[bytes], columns: int, folder: str, names: Sequence[str]) -> np.ndarray:
    """Parse the first line of each file, bit for bit like ``np.loadtxt``, to (file, column) float64.

    Raises BadInput, with folder and name, for another count of numbers, NaN or infinity.
    """
    lines = [data.partition(b"\n")[0].strip() for data in contents]
    values = _parse_as_json(lines, columns)
    if values is None:
        rows = [_parse_line(line, columns, f"{folder}/{name}") for line, name in zip(lines, names, strict=True)]
        values = np.array(rows, dtype=np.float64).reshape(-1, columns)
    good = np.isfinite(values).all(axis=1)
    if not good.all():
        raise BadInput(f"{folder}/{names[int(np.argmin(good))]}", "finite numbers", "NaN or infinity")
    return values


def parse_segments(data: bytes, path: str) -> list[Segment]:
    """Read action_train.txt, action_val.txt or action_test.txt, which has no labels. Ignores blank lines.

    Raises BadInput that names the line for another header or a malformed row.
    """
    try:
        lines = data.decode("utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise BadInput(path, "UTF-8 text", str(error)) from error
    header = lines[0].split()
    if tuple(header) not in (_LIST_COLUMNS, tuple(name for name in _LIST_COLUMNS if name != "action_label")):
        raise BadInput(path, f"the header {' '.join(_LIST_COLUMNS)}, or that without action_label", repr(lines[0][:80]))
    located_rows = ((f"{path}:{number}", line.split()) for number, line in enumerate(lines[1:], 2))
    return [_segment(header, words, location) for location, words in located_rows if words]


def listed_segments(raw: RawTree, sequence: str) -> tuple[list[Segment], str]:
    """The segments of one sequence and the path of their list; empty and "" if no list names the sequence."""
    for name in raw.names(LISTS, ".txt"):
        if _LIST_FILE.fullmatch(name):
            path = f"{LISTS}/{name}"
            segments = parse_segments(raw.read(path, _LARGEST_LIST), path)
            matching = [segment for segment in segments if segment.sequence == sequence]
            if matching:
                return sorted(matching, key=lambda segment: segment.start), path
    return [], ""


def _parse_as_json(lines: list[bytes], columns: int) -> np.ndarray | None:
    """Parse all lines in one call, which is fast. Returns None unless they are JSON numbers with single spaces.

    The check of characters excludes other JSON values. "-0" is excluded because JSON drops its sign.
    """
    if b"".join(lines).translate(None, b"0123456789+-.eE "):
        return None
    text = b"[[" + b"],[".join(lines).replace(b" ", b",") + b"]]"
    if b"-0," in text or b"-0]" in text:
        return None
    try:
        rows = orjson.loads(text)
    except orjson.JSONDecodeError:
        return None
    return np.array(rows, dtype=np.float64) if set(map(len, rows)) == {columns} else None


def _parse_line(line: bytes, columns: int, path: str) -> list[float]:
    words = line.split()
    if len(words) != columns:
        raise BadInput(path, f"{columns} numbers", f"{len(words)}")
    try:
        if b"_" in line:  # float() takes 1_0 for 10
            raise ValueError(f"could not convert {line[:40]!r}")
        return [float(word) for word in words]
    except ValueError as error:
        raise BadInput(path, f"{columns} numbers", str(error)[:120]) from error


def _read(raw: RawTree, folder: str, files: list[str], columns: int) -> np.ndarray:
    return parse_rows(raw.read_folder(folder, files), columns, folder, files)


def _folder_of(raw: RawTree, folder: str, kind: str) -> str:
    """The path of a folder whose case differs between releases (hand_pose_mano, hand_pose_MANO)."""
    folder_path = raw.root / folder
    matching = sorted(item.name for item in folder_path.iterdir() if item.name.lower() == kind)
    return f"{folder}/{matching[-1] if matching else kind}"


def _frame_files(raw: RawTree, folder: str) -> set[str]:
    return {name for name in raw.names(folder) if _FRAME_FILE.fullmatch(name)}


def _refuse_other_hands(raw: RawTree, folder: str, hand_folder: str, hand_source: HandSource) -> None:
    """Raise BadInput that names the setting if a copy has only hands of the other kind."""
    other: HandSource = "keypoints" if hand_source == "mano" else "mano"
    if not _frame_files(raw, hand_folder) and _frame_files(raw, _folder_of(raw, folder, HAND_FOLDERS[other][0])):
        remedy = f"download the pose archive of this subject, or set hands: {other}, which reads what is there"
        raise BadInput(hand_folder, "a folder of NNNNNN.txt files", "none", remedy)


def _common_files(raw: RawTree, folders: list[str]) -> list[str]:
    """Names of the frame files. Raises BadInput that names a missing file if folders differ or frames have a gap."""
    names = {folder: _frame_files(raw, folder) for folder in folders}
    for folder, frame_files in names.items():
        if not frame_files:
            raise BadInput(folder, "a folder of NNNNNN.txt files", "none", "download the pose archive of this subject")
    numbers = sorted(int(name[:6]) for name in set().union(*names.values()))
    expected = [f"{number:06d}.txt" for number in range(numbers[0], numbers[-1] + 1)]
    for folder, frame_files in names.items():
        missing = next((name for name in expected if name not in frame_files), None)
        if missing is not None:
            raise BadInput(f"{folder}/{missing}", f"one file for each of {len(expected)} frames", "nothing there")
    return expected


def _check_ids(folder: str, files: list[str], values: np.ndarray, count: int) -> None:
    is_known = np.isin(values, np.arange(count))
    if not is_known.all():
        index = int(np.argmin(is_known))
        raise BadInput(f"{folder}/{files[index]}", f"a whole number from 0 to {count - 1}", f"{values[index]}")


def _segment(header: list[str], words: list[str], location: str) -> Segment:
    if len(words) != len(header):
        raise BadInput(location, f"{len(header)} words", f"{len(words)}")
    words_by_column = dict(zip(header, words, strict=True))
    path = words_by_column.pop("path")
    if not _SEQUENCE.fullmatch(path):
        raise BadInput(location, "a path like subject1/h1/0", repr(path[:80]))
    for name, word in words_by_column.items():
        if not (word.isascii() and word.isdigit() and len(word) <= _LONGEST_NUMBER):
            raise BadInput(location, f"a whole number as {name}", repr(word[:80]))
    numbers = {name: int(word) for name, word in words_by_column.items()}
    label = numbers.get("action_label")
    if label is not None and not 0 < label < len(ACTIONS):
        raise BadInput(location, f"an action label from 1 to {len(ACTIONS) - 1}", f"{label}")
    if numbers["start_act"] > numbers["end_act"]:
        raise BadInput(location, "a first frame before the last", f"{numbers['start_act']} to {numbers['end_act']}")
    return Segment(path, label, numbers["start_act"], numbers["end_act"])


PARAMETERS_NOTE = (
    "MANO in the camera's frame: absolute axis-angles, betas per frame, translation added to the rest wrist"
)
PARAMETERS = HandConvention(
    translation="transl", fingers="absolute", shape="betas per frame", left_shape="as released", note=PARAMETERS_NOTE
)
FITTED_NOTE = "21 joints in the camera's frame: a MANO-layout hand was fitted to them, one shape per sequence"
FITTED = HandConvention(translation="wrist", fingers="absolute", shape="fitted", left_shape="unused", note=FITTED_NOTE)
_PARAMETERS, _KEYPOINTS = 62, 64  # numbers of one hand; left comes first


@dataclass(frozen=True)
class ParameterHands:
    """Hands from ``hand_pose_mano``: left then right: flag, transl 3, orient 3, fingers 45, betas 10."""

    frames: SequenceFrames
    models: HandPair

    def tracks(self, start: int, stop: int) -> tuple[dict[Side, HandTrack], float | None]:
        """Hands of frames ``start`` to ``stop`` (exclusive), and None in place of a fit error."""
        return {side: self._track(side, slice(start, stop)) for side in SIDES}, None

    def joints_m(self) -> np.ndarray:
        """(frame, 42, 3) joints of left and right hand in the world, metres; NaN if a hand is not annotated."""
        return hand_joints_m({side: self._track(side, slice(None)) for side in SIDES}, self.models)

    def _track(self, side: Side, rows: slice) -> HandTrack:
        numbers = self.frames.hands[rows]
        block = numbers[:, :_PARAMETERS] if side == "left" else numbers[:, _PARAMETERS:]
        camera = self.frames.camera[rows]
        source = SourceHand(block[:, 1:4], block[:, 4:7], block[:, 7:52], block[:, 52:62], valid=block[:, 0] != 0)
        return to_track(source, PARAMETERS, self.models[side], FrameChange(camera[:, :3, :3], camera[:, :3, 3]))


class KeypointHands:
    """Hands from ``hand_pose``: left then right: flag, 21 joints in OpenPose's order. One shape for the sequence."""

    def __init__(self, frames: SequenceFrames, models: HandPair) -> None:
        self.models = models
        self.points: dict[Side, np.ndarray] = {side: _world_joints(frames, side) for side in SIDES}
        valid_points: dict[Side, np.ndarray] = {
            side: points[valid] for side, points in self.points.items() if (valid := _is_valid(points)).any()
        }
        self.betas = fit_shape(valid_points, models) if valid_points else np.zeros(10)

    def joints_m(self) -> np.ndarray:
        """(frame, 42, 3) joints of left and right hand in the world, metres; NaN if a hand is not annotated."""
        return np.concatenate([self.points[side] for side in SIDES], axis=1)

    def tracks(self, start: int, stop: int) -> tuple[dict[Side, HandTrack], float | None]:
        """Fitted hands of frames ``start`` to ``stop`` (exclusive), and the mean fit error in metres."""
        tracks, errors = dict[Side, HandTrack](), []
        for side, points in self.points.items():
            tracks[side], error = self._fit(side, points[start:stop])
            errors.append(error)
        all_errors = np.concatenate(errors)
        return tracks, float(all_errors.mean()) if len(all_errors) else None

    def _fit(self, side: Side, points: np.ndarray) -> tuple[HandTrack, np.ndarray]:
        """Fit one hand, each run of valid frames separately. Returns track and (valid frame, 21) error in metres."""
        valid = _is_valid(points)
        numbers, errors = np.zeros((len(points), 3 + 3 + 45)), [np.zeros((0, 21))]
        for first, last in runs(valid):
            fit = fit_hands({side: points[first:last]}, self.models, self.betas)[side]
            numbers[first:last] = np.concatenate((fit.wrist_m, fit.global_orient, fit.hand_pose), axis=1)
            errors.append(fit.error_m)
        track = hand_track(numbers[:, :3], numbers[:, 3:6], numbers[:, 6:], self.betas[None], valid)
        return track, np.concatenate(errors)


def _is_valid(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(points).all(axis=(1, 2)))


def _world_joints(frames: SequenceFrames, side: Side) -> np.ndarray:
    """(frame, 21, 3) joints in hoidata's order and the world, metres; NaN if the flag is 0."""
    block = frames.hands[:, :_KEYPOINTS] if side == "left" else frames.hands[:, _KEYPOINTS:]
    joints_camera = openpose_to_mano_order(block[:, 1:].reshape(-1, 21, 3))
    joints_world = joints_camera @ frames.camera[:, :3, :3].transpose(0, 2, 1) + frames.camera[:, None, :3, 3]
    return np.where(block[:, :1, None] != 0, joints_world, np.nan)
