"""Adapters compared with naive readers: frames per second to joints and object poses, and H2O's text files.

``python -m bench adapters``. Both read the same sequences and return world joints of both hands and object poses
for each frame of the clips. The results are compared. The adapters also compute the SHA-256 of each file, and read the
frames around the clips.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.harness import Times, embedded_root, medians, show
from bench.naive import READERS, NaiveHands, Poses
from hoidata.clips.clip import SIDES, Clip
from hoidata.clips.hand_parameters import hands_for
from hoidata.datasets import Adapter, RawTree, SequenceKey, get_adapter
from hoidata.datasets.h2o.files import parse_rows
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandPair, load_embedded_hands, track_joints

SEQUENCES = {"h2o": 1, "grab": 3, "arctic": 2}
TOLERANCE_M = 2e-6  # half of float32's step at some metres, over a chain of joints
TEXT_COLUMNS = {"cam_pose": 16, "hand_pose_mano": 124, "obj_pose_rt": 17, "action_label": 1}


@dataclass(frozen=True)
class Sample:
    """The first sequences of one dataset, with the source frames of their clips."""

    adapter: Adapter
    root: Path
    hands: HandPair
    frames: dict[SequenceKey, np.ndarray]

    @property
    def n_frames(self) -> int:
        return sum(map(len, self.frames.values()))


def sample(name: str, root: Path) -> Sample:
    adapter = get_adapter(name)
    hands = hands_for(adapter.hand_convention, load_embedded_hands())
    keys = adapter.sequences(root)[: SEQUENCES[name]]
    clips_by_sequence = {key: _clips(adapter, root, hands, key) for key in keys}
    frames = {key: np.concatenate([clip.source_frames for clip in clips]) for key, clips in clips_by_sequence.items()}
    return Sample(adapter, root, hands, frames)


def _clips(adapter: Adapter, root: Path, hands: HandPair, key: SequenceKey) -> list[Clip]:
    return [item for item in adapter.load(RawTree(root), key, hands) if isinstance(item, Clip)]


def read_ours(chosen: Sample) -> Poses:
    """Joints and object poses of the clips, read with the adapter."""
    clips = [clip for key in chosen.frames for clip in _clips(chosen.adapter, chosen.root, chosen.hands, key)]
    joints = [
        np.stack([track_joints(clip.hands[side], chosen.hands[side]) for side in SIDES], axis=1) for clip in clips
    ]
    poses = np.tile(np.eye(4), (chosen.n_frames, 1, 1))
    poses[:, :3, :3] = rotvec_to_rotmat(np.concatenate([clip.object.rotvec for clip in clips]))
    poses[:, :3, 3] = np.concatenate([clip.object.translation_m for clip in clips])
    return Poses(np.concatenate(joints), poses)


def read_naive(chosen: Sample, naive: NaiveHands) -> Poses:
    read = READERS[chosen.adapter.name]
    parts = [read(chosen.root, key.name, frames, naive) for key, frames in chosen.frames.items()]
    return Poses(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def largest_difference_m(ours: Poses, naive: Poses, valid: np.ndarray) -> float:
    """The largest difference of joints of valid hands, and of points 10 cm from the object's origin."""
    points = np.concatenate([np.zeros((1, 3)), 0.1 * np.eye(3)])
    moved = [points @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3] for pose in (ours[1], naive[1])]
    joints = np.abs(ours.joints_m - naive.joints_m).max(axis=(2, 3))
    return max(float(joints[valid].max()), float(np.abs(moved[0] - moved[1]).max()))


def _valid(chosen: Sample) -> np.ndarray:
    clips = [clip for key in chosen.frames for clip in _clips(chosen.adapter, chosen.root, chosen.hands, key)]
    return np.concatenate([np.stack([clip.hands[side].valid for side in SIDES], axis=1) for clip in clips])


def compare_readers(corpora: Path) -> None:
    rows = []
    for name in SEQUENCES:
        chosen = sample(name, corpora / name)
        naive = NaiveHands(chosen.hands)
        difference = largest_difference_m(read_ours(chosen), read_naive(chosen, naive), _valid(chosen))
        if difference > TOLERANCE_M * 10:
            raise AssertionError(f"{name}: the naive reader differs by {difference} m")
        times = medians({"naive": lambda c=chosen, n=naive: read_naive(c, n), "ours": lambda c=chosen: read_ours(c)})
        speed = {kind: f"{chosen.n_frames / time.median:,.0f}" for kind, time in times.items()}
        rows.append(
            (
                name,
                str(chosen.n_frames),
                *speed.values(),
                *ratios(times["naive"], times["ours"]),
                f"{difference * 1e6:.2f} um",
                f"{times['ours'].first:.2f} s",
            )
        )
    speeds = ("naive frames/s", "adapter frames/s", "ratio", "ratio, processor")
    columns = ("dataset", "frames", *speeds, "largest difference", "first call")
    show("Raw files to joints and poses, one process", columns, rows)


def compare_text(corpora: Path) -> None:
    """Read H2O's four files per frame of one sequence: np.loadtxt per file, or ``parse_rows`` per folder."""
    camera_folder = sorted(corpora.glob("h2o/subject*/*/*/cam4"))[0]
    names = sorted(path.name for path in (camera_folder / "cam_pose").iterdir())
    relative_folders = {kind: (camera_folder / kind).relative_to(corpora / "h2o").as_posix() for kind in TEXT_COLUMNS}

    def loadtxt() -> list[np.ndarray]:
        return [np.array([np.loadtxt(camera_folder / kind / name, ndmin=1) for name in names]) for kind in TEXT_COLUMNS]

    def read_folders() -> list[np.ndarray]:
        tree = RawTree(corpora / "h2o")
        return [
            parse_rows(tree.read_folder(relative_folders[kind], names), columns, relative_folders[kind], names)
            for kind, columns in TEXT_COLUMNS.items()
        ]

    if [rows.tobytes() for rows in loadtxt()] != [rows.tobytes() for rows in read_folders()]:
        raise AssertionError("parse_rows and np.loadtxt differ")
    times = medians({"np.loadtxt, four calls per frame": loadtxt, "read_folder with SHA-256, parse_rows": read_folders})
    base = times["np.loadtxt, four calls per frame"]
    rows = [(kind, f"{len(names) / time.median:,.0f}", *ratios(base, time)) for kind, time in times.items()]
    columns = ("reader", "frames/s", "ratio", "ratio, processor")
    show(f"H2O text, {len(names)} frames of 16, 124, 17 and 1 numbers, values bit-equal", columns, rows)


def ratios(base: Times, time: Times) -> tuple[str, str]:
    return f"{base.median / time.median:.1f}x", f"{base.processor / time.processor:.1f}x"


def main() -> None:
    root = embedded_root()
    compare_readers(root)
    compare_text(root)
