"""H2O (Kwon et al. 2021): per-frame text files of five cameras; hands and objects in the camera's frame.

Only the head camera (cam4) is read, because action labels exist only there. Its pose files are camera-to-world.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hoidata.adapters import checks
from hoidata.adapters.base import DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import ObjectModel
from hoidata.schema.clip import SIDES, Clip, HandTrack, ObjectTrack, Side, WorldFrame
from hoidata.schema.hand_parameters import FrameChange, HandConvention, SourceHand, to_track

CAMERA = "cam4"
OBJECTS = ("", "book", "espresso", "lotion", "spray", "milk", "cocoa", "chips", "cappuccino")  # by class id
OLD_NAMES = {"spray": "lotion_spray", "cocoa": "ovomaltine", "chips": "pringles", "cappuccino": "starbucks"}
FRAME_FILE = re.compile(r"\d{6}\.txt")
FRAME = WorldFrame(None, "unknown", "H2O's camera-rig world, right-handed, metres; axes not documented")
CONVENTION = HandConvention(
    translation="transl",
    fingers="absolute",
    shape="betas per frame",
    left_shape="as released",
    note="MANO in the camera's frame: absolute axis-angles, betas per frame, translation added to the rest wrist",
)
PARTS = (
    DatasetPart("pose files of the head camera", ("subject*/*/*/cam4/obj_pose_rt/*.txt",), "subjectN_pose_v1_1.tar.gz"),
    DatasetPart("object meshes", ("object/*/*.obj",), "object.zip"),
    DatasetPart("segments of all subjects", ("label_split/action_*.txt",), "label_split.zip", optional=True),
)
_SHELF = ("book", "espresso", "lotion", "spray", "milk", "cocoa", "chips", "cappuccino")
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


@dataclass(frozen=True)
class _Frames:
    """The numbers of one sequence, frame axis first, as in the files (camera frame, metres)."""

    folder: str
    first: int
    camera: np.ndarray
    hands: np.ndarray
    object: np.ndarray
    label: np.ndarray


@dataclass(frozen=True)
class H2OAdapter:
    """Raw root: ``object/<name>/<name>.obj`` and ``subjectN/<place>/<number>/cam4/<kind>/NNNNNN.txt``.

    margin_frames: frames kept before and after each labelled run. shortest_frames: runs must be this long or longer.
    A run is split where the tracked object is not the one its label names.
    """

    margin_frames: int = 0
    shortest_frames: int = 21
    name: str = "h2o"
    version: str = "1.1"
    licence: str = "research use after registration; no licence text is published with the files"
    where_to_register: str = "https://h2odataset.ethz.ch (subjectN_pose_v1_1.tar.gz, object.zip)"
    needs_mano: bool = True
    source_fps: float = 30.0
    may_be_shared: bool = False
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per ``subjectN/<place>/<number>`` that has a cam4 folder."""
        found = sorted(Path(root).glob(f"subject*/*/*/{CAMERA}"))
        parts = [path.relative_to(root).parts for path in found if path.is_dir()]
        return [SequenceKey(self.name, part[0], "/".join(part[:3])) for part in parts]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per run of frames with one non-zero action label and the object that label names."""
        frames = _read_frames(raw, f"{key.name}/{CAMERA}")
        models: dict[str, ObjectModel] = {}
        results: list[Clip | Quarantined] = []
        for start, stop in label_runs(frames.label, self.shortest_frames):
            pieces = _tracked_pieces(frames, start, stop, self.shortest_frames)
            if not pieces:
                problem = _untracked(frames, start, stop)
                results.append(Quarantined.from_error(_clip_id(key, frames, start, stop), problem))
            for piece in pieces:
                name = ACTIONS[int(frames.label[start])][1]
                mesh_path = _mesh_path(raw, name)
                if name not in models:
                    models[name] = _object_model(raw, name, mesh_path)
                clip = self._convert(key, frames, *piece, models[name], hands)
                results.append(replace(clip, sources=raw.recorded(frames.folder, mesh_path)))
        return results

    def _convert(
        self, key: SequenceKey, frames: _Frames, start: int, stop: int, model: ObjectModel, hands: HandPair
    ) -> Clip:
        verb, noun = ACTIONS[int(frames.label[start])]
        clip_id = _clip_id(key, frames, start, stop)
        start, stop = _with_margin(frames, start, stop, self.margin_frames)
        camera = frames.camera[start:stop]
        world_from_object = camera @ frames.object[start:stop, 1:].reshape(-1, 4, 4)
        return Clip(
            clip_id=clip_id,
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
            hands={side: _hand(side, frames.hands[start:stop], camera, hands) for side in SIDES},
            object=ObjectTrack(
                model,
                rotmat_to_rotvec(world_from_object[:, :3, :3]).astype(np.float32),
                world_from_object[:, :3, 3].astype(np.float32),
            ),
            source_frames=np.arange(frames.first + start, frames.first + stop, dtype=np.int32),
            gravity=None,
            gravity_note="H2O does not document the axes of its world",
            verb=verb,
            object_words=noun,
            source_fps=self.source_fps,
        )


def label_runs(label: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """Half-open ranges of one non-zero label that are at least ``shortest`` frames long. label: (frame,) int."""
    edges = np.flatnonzero(np.diff(label)) + 1
    starts, stops = np.r_[0, edges], np.r_[edges, len(label)]
    return [(int(a), int(b)) for a, b in zip(starts, stops, strict=True) if label[a] != 0 and b - a >= shortest]


def _hand(side: Side, block: np.ndarray, camera: np.ndarray, hands: HandPair) -> HandTrack:
    """block: (frame, 124) = left then right: flag, transl 3, orient 3, fingers 45, betas 10; camera: (frame, 4, 4)."""
    block = block[:, :62] if side == "left" else block[:, 62:]
    source = SourceHand(
        translation_m=block[:, 1:4],
        global_orient=block[:, 4:7],
        fingers=block[:, 7:52],
        betas=block[:, 52:62],
        valid=block[:, 0] != 0,
    )
    return to_track(source, CONVENTION, hands[side], FrameChange(camera[:, :3, :3], camera[:, :3, 3]))


def _clip_id(key: SequenceKey, frames: _Frames, start: int, stop: int) -> str:
    return f"{key}/{frames.first + start:06d}-{frames.first + stop - 1:06d}"


def _tracked_pieces(frames: _Frames, start: int, stop: int, shortest: int) -> list[tuple[int, int]]:
    """The parts of a run, ``shortest`` frames or longer, in which the tracked object is the one the label names."""
    expected = OBJECTS.index(ACTIONS[int(frames.label[start])][1])
    tracked = (frames.object[start:stop, 0] == expected).astype(int)
    return [(start + first, start + last) for first, last in label_runs(tracked, shortest)]


def _untracked(frames: _Frames, start: int, stop: int) -> BadInput:
    label = int(frames.label[start])
    classes = np.unique(frames.object[start:stop, 0].astype(int)).tolist()
    noun = ACTIONS[label][1]
    wanted = f"class {OBJECTS.index(noun)} ({noun}), the object of action {label}, for more than 20 frames"
    return BadInput(f"{frames.folder}/obj_pose_rt", wanted, f"classes {classes}", "check the annotation")


def _with_margin(frames: _Frames, start: int, stop: int, margin: int) -> tuple[int, int]:
    """The piece and up to ``margin`` frames on both sides, as far as the same object is tracked."""
    same = frames.object[:, 0] == frames.object[start, 0]
    first, last = max(0, start - margin), min(len(same), stop + margin)
    others = np.flatnonzero(~same)
    before, after = others[others < start], others[others >= stop]
    return max(first, before[-1] + 1 if len(before) else 0), min(last, after[0] if len(after) else len(same))


def _mesh_path(raw: RawTree, name: str) -> str:
    for known in (name, OLD_NAMES.get(name, name)):
        exact = f"{known}.obj"
        names = raw.names(f"object/{known}", ".obj")
        if names:
            return f"object/{known}/{exact if exact in names else names[0]}"
    raise BadInput(f"object/{name}/{name}.obj", "the object's mesh", "nothing there", "unpack object.zip here")


def _object_model(raw: RawTree, name: str, path: str) -> ObjectModel:
    mesh = load_mesh(raw.file(path))
    return ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8))


def _read_frames(raw: RawTree, folder: str) -> _Frames:
    kinds = {kind: _folder_of(raw, folder, kind) for kind in ("cam_pose", "hand_pose_mano", "obj_pose_rt")}
    kinds["action_label"] = f"{folder}/action_label"
    files = _common_files(raw, kinds)
    camera = _numbers(raw, kinds["cam_pose"], files, 16)
    hands = _numbers(raw, kinds["hand_pose_mano"], files, 124)
    objects = _numbers(raw, kinds["obj_pose_rt"], files, 17)
    label = _numbers(raw, kinds["action_label"], files, 1)
    _check_ids(kinds["action_label"], files, label[:, 0], len(ACTIONS))
    _check_ids(kinds["obj_pose_rt"], files, objects[:, 0], len(OBJECTS))
    camera = camera.reshape(-1, 4, 4)
    checks.rigid_transforms(kinds["cam_pose"], files, camera)
    tracked = np.flatnonzero(objects[:, 0])
    names = [files[frame] for frame in tracked]
    checks.rigid_transforms(kinds["obj_pose_rt"], names, objects[tracked, 1:].reshape(-1, 4, 4))
    return _Frames(folder, int(files[0][:6]), camera, hands, objects, label[:, 0].astype(int))


def _folder_of(raw: RawTree, folder: str, kind: str) -> str:
    """The real name of a folder whose case differs between releases (hand_pose_mano, hand_pose_MANO)."""
    place = raw.root / folder
    found = sorted(item.name for item in place.iterdir() if item.name.lower() == kind)
    return f"{folder}/{found[-1] if found else kind}"


def _common_files(raw: RawTree, kinds: dict[str, str]) -> list[str]:
    """Names of the frame files, the same in every folder and without a gap; else BadInput names the missing one."""
    names = {folder: {n for n in raw.names(folder) if FRAME_FILE.fullmatch(n)} for folder in kinds.values()}
    for folder, found in names.items():
        if not found:
            remedy = "download the pose archive of this subject"
            if folder == kinds["action_label"]:
                remedy += "; nothing to do for subject4, whose action labels are withheld"
            raise BadInput(folder, "a folder of NNNNNN.txt files", "none", remedy)
    numbers = sorted(int(name[:6]) for name in set().union(*names.values()))
    expected = [f"{number:06d}.txt" for number in range(numbers[0], numbers[-1] + 1)]
    for folder, found in names.items():
        missing = next((name for name in expected if name not in found), None)
        if missing is not None:
            raise BadInput(f"{folder}/{missing}", f"one file for each of {len(expected)} frames", "nothing there")
    return expected


def _numbers(raw: RawTree, folder: str, files: list[str], columns: int) -> np.ndarray:
    """(frame, column) float64 from the first line of each file."""
    rows = []
    for name, data in zip(files, raw.read_folder(folder, files), strict=True):
        try:
            row = [float(word) for word in data.partition(b"\n")[0].split()]
        except ValueError as error:
            raise BadInput(f"{folder}/{name}", f"{columns} numbers", str(error)) from error
        if len(row) != columns:
            raise BadInput(f"{folder}/{name}", f"{columns} numbers", f"{len(row)}")
        rows.append(row)
    values = np.array(rows, dtype=np.float64)
    good = np.isfinite(values).all(axis=1)
    if not good.all():
        raise BadInput(f"{folder}/{files[int(np.argmin(good))]}", "finite numbers", "NaN or infinity")
    return values


def _check_ids(folder: str, files: list[str], values: np.ndarray, count: int) -> None:
    known = np.isin(values, np.arange(count))
    if not known.all():
        at = int(np.argmin(known))
        raise BadInput(f"{folder}/{files[at]}", f"a whole number from 0 to {count - 1}", f"{values[at]}")
