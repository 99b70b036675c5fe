"""Strict reader of BVH motion files whose joints turn in the order Y, X, Z.

A BVH file is a text tree of joints followed by one line of numbers per frame. Units, handedness and what the joints
mean are the dataset's affair; angles come out in radians, everything else as written.
"""

import gzip
import io
import zlib
from dataclasses import dataclass, replace

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat

ROOT_CHANNELS = "6 Xposition Yposition Zposition Yrotation Xrotation Zrotation"
JOINT_CHANNELS = "3 Yrotation Xrotation Zrotation"
MAX_TEXT_BYTES = 32 * 2**20  # the largest released file has 4.3 MB
MAX_JOINTS = 256
MAX_FRAMES = 1_000_000


@dataclass(frozen=True)
class BvhMotion:
    """A skeleton and its motion in the file's own unit and axes.

    names: joints in file order, parents before children; end sites are no joints.
    parents: (joint,) index of the parent, -1 for the root. offsets: (joint, 3) from the parent, in the parent's frame.
    root_position: (frame, 3). angles_yxz_rad: (frame, joint, 3) angles about Y, X and Z;
    the local rotation is ``Ry @ Rx @ Rz`` on column vectors.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    root_position: np.ndarray
    angles_yxz_rad: np.ndarray
    frame_time_s: float

    @property
    def n_frames(self) -> int:
        return len(self.root_position)

    def at(self, frames: np.ndarray) -> "BvhMotion":
        """The same skeleton at some frames only (index array or slice)."""
        return replace(self, root_position=self.root_position[frames], angles_yxz_rad=self.angles_yxz_rad[frames])

    def seen_in_mirror_x(self) -> "BvhMotion":
        """The motion after negating the x axis of the world and of every joint; changes handedness."""
        flip = np.array([-1.0, 1.0, 1.0])
        turn = np.array([-1.0, 1.0, -1.0])
        return replace(
            self,
            offsets=self.offsets * flip,
            root_position=self.root_position * flip,
            angles_yxz_rad=self.angles_yxz_rad * turn,
        )

    def world_joints(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (frame, joint, 3) in the file's unit and rotations ``world_from_joint`` (frame, joint, 3, 3)."""
        local = angles_yxz_to_rotmat(self.angles_yxz_rad)
        rotations = local.copy()
        positions = np.empty(self.angles_yxz_rad.shape)
        positions[:, 0] = self.root_position + self.offsets[0]
        for joint, parent in enumerate(self.parents[1:], start=1):
            rotations[:, joint] = rotations[:, parent] @ local[:, joint]
            positions[:, joint] = positions[:, parent] + rotations[:, parent] @ self.offsets[joint]
        return positions, rotations


def angles_yxz_to_rotmat(angles_yxz_rad: np.ndarray) -> np.ndarray:
    """Angles about Y, X, Z in radians (..., 3) to ``Ry @ Rx @ Rz`` (..., 3, 3), column vectors."""
    axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turn_y, turn_x, turn_z = (rotvec_to_rotmat(angles_yxz_rad[..., i, None] * axes[i]) for i in range(3))
    return turn_y @ turn_x @ turn_z


def parse_bvh(text: str, where: str) -> BvhMotion:
    """Read the text of a BVH file; ``where`` names the file in errors.

    Raises BadInput on anything that is not exactly this dialect: root channels X, Y, Z position and Y, X, Z rotation,
    other joints Y, X, Z rotation; as many frames and columns as announced; finite numbers only.
    """
    lines = text.splitlines()
    motion_line = next((i for i, line in enumerate(lines) if line.strip() == "MOTION"), None)
    if motion_line is None:
        raise BadInput(where, "a line MOTION after the hierarchy", f"none in {len(lines)} lines")
    skeleton = _SkeletonReader("\n".join(lines[:motion_line]), where)
    skeleton.read()
    names = skeleton.names
    frames, frame_time_s = _parse_motion_head(lines[motion_line + 1 : motion_line + 3], where)
    rows = [line for line in lines[motion_line + 3 :] if line.strip()]
    table = _parse_rows(rows, frames, 3 + 3 * len(names), where)
    return BvhMotion(
        names=tuple(names),
        parents=np.array(skeleton.parents),
        offsets=np.array(skeleton.offsets),
        root_position=table[:, :3],
        angles_yxz_rad=np.deg2rad(table[:, 3:].reshape(frames, len(names), 3)),
        frame_time_s=frame_time_s,
    )


def unpack_text(data: bytes, where: str, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Text of a gzip file's bytes, at most ``max_bytes`` once unpacked. Raises BadInput when it cannot be read."""
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            unpacked = stream.read(max_bytes + 1)
        text = unpacked.decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise BadInput(where, "gzipped text", f"{type(error).__name__}: {error}") from error
    if len(unpacked) > max_bytes:
        raise BadInput(where, f"at most {max_bytes} bytes of text", "more", "check that it is the released file")
    return text


class _SkeletonReader:
    """Recursive descent over the words before MOTION; joints come out in file order, end sites are checked and left."""

    def __init__(self, text: str, where: str) -> None:
        self.words = text.split()
        self.place = 0
        self.where = where
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []

    def read(self) -> None:
        self.expect("HIERARCHY", "ROOT")
        self.read_joint(-1)
        if self.place < len(self.words):
            raise self.wrong("MOTION after the one root", self.words[self.place])

    def read_joint(self, parent: int) -> None:
        joint = len(self.names)
        if joint >= MAX_JOINTS:
            raise self.wrong(f"at most {MAX_JOINTS} joints", "more")
        self.names.append(self.take())
        self.parents.append(parent)
        self.expect("{", "OFFSET")
        self.offsets.append(self.read_numbers())
        self.expect("CHANNELS", *(ROOT_CHANNELS if parent < 0 else JOINT_CHANNELS).split())
        while (word := self.take()) != "}":
            if word == "JOINT":
                self.read_joint(joint)
            elif word == "End":
                self.expect("Site", "{", "OFFSET")
                self.read_numbers()
                self.expect("}")
            else:
                raise self.wrong("JOINT, End Site or a closing brace", word)

    def read_numbers(self) -> list[float]:
        words = [self.take() for _ in range(3)]
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            raise self.wrong("three numbers after OFFSET", " ".join(words)) from None
        if not np.isfinite(numbers).all():
            raise self.wrong("finite numbers after OFFSET", " ".join(words))
        return numbers

    def expect(self, *words: str) -> None:
        for word in words:
            if (got := self.take()) != word:
                raise self.wrong(f"{word} (in {' '.join(words)})", got)

    def take(self) -> str:
        if self.place >= len(self.words):
            raise self.wrong("more of the hierarchy", "its end")
        self.place += 1
        return self.words[self.place - 1]

    def wrong(self, expected: str, got: str) -> BadInput:
        after = f"after joint {self.names[-1][:40]}" if self.names else "at the start"
        return BadInput(f"{self.where} {after}", expected, repr(got[:40]))


def _parse_motion_head(lines: list[str], where: str) -> tuple[int, float]:
    words = " ".join(lines).split()
    try:
        if words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
            raise ValueError
        frames, frame_time_s = int(words[1]), float(words[4])
    except (ValueError, IndexError):
        raise BadInput(where, "lines 'Frames: N' and 'Frame Time: seconds'", repr(" ".join(lines)[:80])) from None
    if not 0 < frames <= MAX_FRAMES or not 1e-4 < frame_time_s < 1:
        raise BadInput(where, f"1 to {MAX_FRAMES} frames of 0.0001 to 1 s", f"{frames} frames of {frame_time_s} s")
    return frames, frame_time_s


def _parse_rows(rows: list[str], frames: int, columns: int, where: str) -> np.ndarray:
    if len(rows) != frames:
        raise BadInput(where, f"{frames} motion lines as announced", f"{len(rows)}")
    words = [row.split() for row in rows]
    wrong = next((i for i, row in enumerate(words) if len(row) != columns), None)
    if wrong is not None:
        raise BadInput(where, f"{columns} columns", f"{len(words[wrong])} in frame {wrong}")
    try:
        table = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise BadInput(where, "numbers", str(error)) from error
    if not np.isfinite(table).all():
        frame, column = np.argwhere(~np.isfinite(table))[0]
        raise BadInput(where, "finite numbers", f"{table[frame, column]} in frame {frame}, column {column}")
    return table
