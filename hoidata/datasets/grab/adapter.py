"""GRAB (Taheri et al. 2020): one NPZ per sequence at 120 Hz, personal hand meshes, objects posed with row vectors.

Its contact labels state per frame and vertex of the object which body part touches it: 0 for none, 21 and 22 for the
left and right hand, 26 to 40 and 41 to 55 for their fingers. For 4,500 frames and 48,370 vertices the 64-bit labels
take 1.7 GB, so they are read in pieces of a few megabytes.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS, SIDES, BodyTrack, Clip, HandTrack, ObjectTrack, Side, SourceContact, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets import checks
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.errors import BadInput
from hoidata.files import load_npz_objects
from hoidata.files.array_pieces import StoredArray, locate_arrays, npz_members
from hoidata.geometry.rotations import canonical_rotvec
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel

# Verb by ``motion_intent``.
INTENTS = {
    **{word: word for word in ("browse", "brush", "call", "chop", "clean", "cook", "drink", "eat", "fly", "inspect")},
    **{word: word for word in ("lift", "open", "pass", "peel", "play", "pour", "screw", "see", "set", "shake")},
    **{word: word for word in ("squeeze", "stamp", "staple", "toast", "use", "wear")},
    "offhand": "hand over",
    "switchON": "switch on",
    "takepicture": "take a picture with",
}
_SHAPES, _SIZES = ("cube", "cylinder", "pyramid", "sphere", "torus"), ("small", "medium", "large")
# The 51 manipulated objects; sizes of the plain shapes are part of their words.
OBJECTS = {
    **{shape + size: f"{size} {shape}" for shape in _SHAPES for size in _SIZES},
    **{name: name for name in ("airplane", "apple", "banana", "binoculars", "bowl", "camera", "cup", "doorknob")},
    **{name: name for name in ("duck", "elephant", "eyeglasses", "flashlight", "flute", "hammer", "hand")},
    **{name: name for name in ("headphones", "knife", "mouse", "mug", "phone", "scissors", "stamp", "stapler")},
    **{name: name for name in ("teapot", "toothbrush", "toothpaste", "train", "watch")},
    "alarmclock": "alarm clock",
    "fryingpan": "frying pan",
    "gamecontroller": "game controller",
    "lightbulb": "light bulb",
    "piggybank": "piggy bank",
    "stanfordbunny": "Stanford bunny",
    "waterbottle": "water bottle",
    "wineglass": "wine glass",
}
# Intents recorded with an object beyond lift, pass and offhand, which GRAB recorded with all but those of ``_NEVER``.
_RECORDED = {
    **{shape + size: "inspect" for shape in _SHAPES for size in _SIZES},
    **{name: "inspect" for name in ("duck", "elephant", "stanfordbunny")},
    **{name: "use" for name in ("doorknob", "hammer", "headphones", "mouse", "piggybank", "scissors")},
    **{name: "play" for name in ("flute", "gamecontroller", "train")},
    **{"airplane": "fly", "alarmclock": "see", "apple": "eat", "banana": "eat peel", "binoculars": "see"},
    **{"bowl": "drink", "camera": "browse takepicture", "cup": "drink pour", "eyeglasses": "clean wear"},
    **{"flashlight": "switchON", "fryingpan": "cook", "hand": "inspect shake", "knife": "chop peel"},
    **{"lightbulb": "screw", "mug": "drink toast", "phone": "call", "stamp": "stamp", "stapler": "staple"},
    **{"teapot": "pour", "toothbrush": "brush", "toothpaste": "squeeze", "watch": "set"},
    **{"waterbottle": "drink open pour shake", "wineglass": "drink toast"},
}
_NEVER = {
    "lift": ("lightbulb", "pyramidsmall", "scissors"),
    "pass": ("doorknob",),
    "offhand": (
        "doorknob", "hammer", "knife", "lightbulb", "pyramidsmall", "teapot", "toothbrush", "toothpaste", "toruslarge",
    ),
}  # fmt: skip
# The 202 pairs of verb and object that GRAB has, in words.
PAIRS = tuple(
    (INTENTS[intent], words)
    for name, words in OBJECTS.items()
    for intent in (*_RECORDED[name].split(), *(general for general, names in _NEVER.items() if name not in names))
)
# Further meshes in GRAB's folder of objects.
OTHER_MESHES = {
    "coffeemug": "coffee mug", "cubemiddle": "middle cube", "rubberduck": "rubber duck", "table": "table",
    "wristwatch": "wristwatch",
}  # fmt: skip
_BEFORE_CAPITAL = re.compile(r"(?<=[a-z])(?=[A-Z])|[_\s-]+")


def verb_words(intent: str) -> str | None:
    """The verb of an intent. An unknown intent is split at capitals, ``_``, ``-`` and blanks; "" gives None."""
    return INTENTS.get(intent) or " ".join(_BEFORE_CAPITAL.split(intent)).strip().lower() or None


def object_words(name: str) -> str:
    """GRAB's joined object name in words, size first: ``cubelarge`` is "large cube". Unknown names are unchanged."""
    return OBJECTS.get(name) or OTHER_MESHES.get(name, name)


TOP_FOLDERS = ("", "GRAB")
FRAME = WorldFrame("+z", "stated", "GRAB's motion-capture world, right-handed, z up, metres")
HAND_NOTE = "MANO: absolute axis-angles, the subject's own rest mesh without betas, translation added to its rest wrist"
CONVENTION = HandConvention(
    translation="transl", fingers="absolute", shape="personal mesh", left_shape="unused", note=HAND_NOTE
)
_FILES = (
    ("sequences", "grab/s*/*.npz", "grab__s1.zip to grab__s10.zip"),
    ("meshes of objects and table", "tools/object_meshes/*/*.ply", "object_meshes.zip"),
    ("the subjects' hand meshes", "tools/subject_meshes/*/*.ply", "tools__subject_meshes.zip"),
)
PARTS = tuple(DatasetPart(name, (pattern, f"GRAB/{pattern}"), archive) for name, pattern, archive in _FILES)
MEMBERS = ("obj_name", "motion_intent", "framerate", "n_frames", "lhand", "rhand", "object")
MAX_COMPONENTS = 45


@dataclass(frozen=True)
class GrabAdapter(AdapterBase):
    """Raw root: ``grab/sN/<object>_<action>_<n>.npz`` and ``tools/``, as the official script unpacks them."""

    facts = facts_of_adapter(__file__)
    margin_frames: int = 0  # at 30 fps: frames kept before the first and after the last frame with contact
    contact: bool = True  # include GRAB's contact labels: 9 bytes per touched vertex and frame, about 10 MB per clip
    body: bool = False  # include the parameters of the subject's SMPL-X body
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per ``grab/sN/*.npz``."""
        files = {path for top in TOP_FOLDERS for path in (Path(root) / top / "grab").glob("s*/*.npz")}
        keys = {SequenceKey(self.name, path.parent.name, f"{path.parent.name}/{path.stem}") for path in files}
        return sorted(keys)

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip of every 4th frame, from the first to the last with object contact, both included."""
        source = _open(raw, key, self.body)
        model = _mesh_model(raw, source.text("obj_name"), source.path_in_release("object", "object_mesh"))
        step = source.fps // FPS
        contact = read_contact(source.file, source.path, source.n_frames, len(model.vertices_m), step, self.contact)
        start, stop = _contact_range(source, contact.touched, self.margin_frames)
        frames = np.arange(start * step, stop * step, step)
        clip = self.new_clip(
            key,
            hands={side: _hand(raw, source, side, frames, hands) for side in SIDES},
            object=_object_track(source, "object", model, frames),
            other_objects=_table(raw, source, frames),
            source_frames=frames.astype(np.int32),
            gravity=np.array([0.0, 0.0, -1.0]),
            verb=verb_words(source.text("motion_intent")),
            object_words=object_words(model.name),
            source_fps=float(source.fps),
            source_contact=contact.cut(start, stop),
            body=_body(source).take(frames) if self.body else None,
        )
        return [replace(clip, sources=raw.sources)]


@dataclass(frozen=True)
class _SequenceFile:
    """The entries of one NPZ file, without its contact labels."""

    top: str  # the folder that contains ``grab/`` and ``tools/``
    path: str  # below the raw root
    file: Path  # on disk
    data: dict[str, Any]

    @property
    def n_frames(self) -> int:
        return self._count("n_frames")

    @property
    def fps(self) -> int:
        """Frame rate. Raises BadInput unless it is a multiple of 30."""
        fps = self._count("framerate")
        if fps % FPS:
            raise BadInput(f"{self.path}: framerate", f"a multiple of {FPS} frames per second", f"{fps}")
        return fps

    def params(self, member: str) -> Mapping[str, Any]:
        """``member.params``. Raises BadInput without ``global_orient`` and ``transl``."""
        params = checks.entry(f"{self.path}: {member}", checks.entry(self.path, self.data, member), "params")
        for name in ("global_orient", "transl"):
            checks.entry(f"{self.path}: {member}.params", params, name)
        return params

    def text(self, *keys: str) -> str:
        """The text entry at nested keys. Raises BadInput for another type."""
        value: Any = self.data
        for key in keys:
            value = checks.entry(self.path, value, key)
        if not isinstance(value, str):
            raise BadInput(f"{self.path}: {'.'.join(keys)}", "text", type(value).__name__)
        return str(value)

    def path_in_release(self, *keys: str) -> str:
        """The path below the raw root of a file that a text entry names relative to ``top``."""
        return _below_top_folder(self.top, self.text(*keys))

    def _count(self, key: str) -> int:
        value = np.asarray(checks.entry(self.path, self.data, key))
        if value.shape or value.dtype.kind not in "fiu" or not 1 <= value < np.inf or value != round(float(value)):
            raise BadInput(f"{self.path}: {key}", "a whole number of 1 or more", repr(value)[:40])
        return int(value)


def _open(raw: RawTree, key: SequenceKey, with_body: bool) -> _SequenceFile:
    top = next((top for top in TOP_FOLDERS if raw.has(_below_top_folder(top, f"grab/{key.name}.npz"))), TOP_FOLDERS[0])
    path = _below_top_folder(top, f"grab/{key.name}.npz")
    file = raw.file(path)
    optional = npz_members(file) & {"table"}
    members = {*MEMBERS, *optional, *(("body",) if with_body else ())}
    return _SequenceFile(top, path, file, load_npz_objects(file, members))


def _below_top_folder(top: str, path: str) -> str:
    return f"{top}/{path}" if top else path


def _contact_range(source: _SequenceFile, touched: np.ndarray, margin: int) -> tuple[int, int]:
    """Half-open range from the first to the last frame with contact, widened by the margin, at 30 fps."""
    frames = np.flatnonzero(touched)
    if not len(frames):
        remedy = "nothing to do: nobody touches the object"
        raise BadInput(f"{source.path}: contact.object", "contact in at least one frame", "none", remedy)
    return max(0, int(frames[0]) - margin), min(len(touched), int(frames[-1]) + 1 + margin)


def _object_track(source: _SequenceFile, member: str, model: ObjectModel, frames: np.ndarray) -> ObjectTrack:
    """Pose of an object. GRAB uses row vectors, x_world = x R + t, so the rotation is transposed."""
    location, pose = f"{source.path}: {member}", source.params(member)
    orient = checks.table(f"{location}.global_orient", pose["global_orient"], 3, source.n_frames)[frames]
    transl = checks.table(f"{location}.transl", pose["transl"], 3, source.n_frames)[frames]
    return ObjectTrack(model, -canonical_rotvec(orient).astype(np.float32), transl.astype(np.float32))


def _table(raw: RawTree, source: _SequenceFile, frames: np.ndarray) -> tuple[ObjectTrack, ...]:
    """The table, if the file has one and its mesh exists."""
    if "table" not in source.data or not raw.has(mesh := source.path_in_release("table", "table_mesh")):
        return ()
    return (_object_track(source, "table", _mesh_model(raw, "table", mesh), frames),)


def _body(source: _SequenceFile) -> BodyTrack:
    return checks.body_track(f"{source.path}: body", source.params("body"), source.n_frames, {"expression": 10})


def _hand(raw: RawTree, source: _SequenceFile, side: Side, frames: np.ndarray, hands: HandPair) -> HandTrack:
    member = {"left": "lhand", "right": "rhand"}[side]
    location, params = f"{source.path}: {member}", source.params(member)
    template = _template(raw, source.path_in_release(member, "vtemp"))
    orient = checks.table(f"{location}.global_orient", params["global_orient"], 3, source.n_frames)
    transl = checks.table(f"{location}.transl", params["transl"], 3, source.n_frames)
    fingers, convention = _fingers(location, params, source.n_frames)
    source_hand = SourceHand(
        translation_m=transl[frames],
        global_orient=orient[frames],
        fingers=fingers[frames],
        betas=np.zeros((1, 10)),  # the personal mesh already has the subject's shape
        template_m=template,
    )
    return to_track(source_hand, convention, hands[side])


def _fingers(location: str, params: Mapping[str, Any], n_frames: int) -> tuple[np.ndarray, HandConvention]:
    """Finger angles ``fullpose`` (frame, 45); if missing, principal components ``hand_pose`` (frame, component)."""
    if "fullpose" in params:
        return checks.table(f"{location}.fullpose", params["fullpose"], 45, n_frames), CONVENTION
    coefficients = np.asarray(checks.entry(location, params, "hand_pose"))
    columns = coefficients.shape[1] if coefficients.ndim == 2 else 0
    columns = columns if 1 <= columns <= MAX_COMPONENTS else 24
    pose = checks.table(f"{location}.hand_pose", coefficients, columns, n_frames)
    return pose, replace(CONVENTION, components=columns)


def _template(raw: RawTree, path: str) -> np.ndarray:
    vertices = raw_mesh(raw, path).vertices
    if vertices.shape != (778, 3):
        raise BadInput(path, "a hand mesh of 778 vertices", f"{len(vertices)}")
    return vertices


def _mesh_model(raw: RawTree, name: str, path: str) -> ObjectModel:
    mesh = raw_mesh(raw, path)
    return ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8))


MAX_LABELS = 32_000_000  # 290 MB; a grasp of a fine mesh touches 6,000 vertices, a tenth of this in 500 frames
_MAX_LABEL = 255


@dataclass(frozen=True)
class ContactLabels:
    """Contact labels of every step-th frame."""

    touched: np.ndarray  # (frame,) bool: the frame has a label
    labels: SourceContact | None  # None if not requested

    def cut(self, start: int, stop: int) -> SourceContact | None:
        """The labels of frames ``start`` to ``stop`` (exclusive), with frames counted from ``start``."""
        if self.labels is None:
            return None
        first, last = np.searchsorted(self.labels.frame, (start, stop))
        part = slice(first, last)
        return SourceContact(
            self.labels.frame[part] - np.int32(start), self.labels.vertex[part], self.labels.label[part]
        )


def read_contact(file: Path, path: str, n_frames: int, n_vertices: int, step: int, with_labels: bool) -> ContactLabels:
    """Read the contact labels of every ``step``-th frame from frame 0 on. Raises BadInput.

    path: for errors. with_labels: return the labels, not only whether a frame has one.
    """
    location = f"{path}: contact.object"
    array = locate_arrays(file, "contact").get("object")
    if array is None or array.shape != (n_frames, n_vertices):
        expected = f"numbers of shape ({n_frames}, {n_vertices}): frames, vertices of the contact mesh"
        raise BadInput(location, expected, "none" if array is None else f"{array.dtype} of shape {array.shape}")
    touched = np.zeros(len(range(0, n_frames, step)), dtype=bool)
    pieces: list[SourceContact] = []
    n_labels = 0
    for labels in map(lambda piece: _labels_of(location, array, step, *piece), array.pieces()):
        touched[labels.frame] = True
        n_labels += len(labels.frame)
        if with_labels:
            if n_labels > MAX_LABELS:
                raise BadInput(
                    location, f"at most {MAX_LABELS} labels", "more", "convert with the setting contact: false"
                )
            pieces.append(labels)
    return ContactLabels(touched, _joined(pieces, array.by_columns) if with_labels else None)


def _labels_of(location: str, array: StoredArray, step: int, first: int, piece: np.ndarray) -> SourceContact:
    """The labels of one piece, with frames counted in steps. first: index of the piece's first row or column."""
    if array.by_columns:
        vertex, frame = np.nonzero(_checked(location, piece[:, ::step]))
        label = piece[:, ::step][vertex, frame]
        vertex = vertex + first
    else:
        skipped = -first % step  # rows before the next multiple of step
        rows = piece[skipped::step]
        frame, vertex = np.nonzero(_checked(location, rows))
        label = rows[frame, vertex]
        frame = frame + (first + skipped) // step
    return SourceContact(frame.astype(np.int32), vertex.astype(np.int32), label.astype(np.uint8))


def _checked(location: str, labels: np.ndarray) -> np.ndarray:
    """Which labels are contact, that is, above 0. Raises BadInput unless all are integers up to 255."""
    if not labels.size:
        return labels > 0
    if labels.dtype.kind == "f" and not (np.isfinite(labels).all() and (labels == np.rint(labels)).all()):
        raise BadInput(location, "whole numbers", "fractions, NaN or infinity")
    if labels.max() > _MAX_LABEL:
        raise BadInput(location, f"labels up to {_MAX_LABEL}", f"{labels.max()}")
    return labels > 0


def _joined(parts: list[SourceContact], by_columns: bool) -> SourceContact:
    """Concatenate parts, sorted by frame and vertex."""
    empty = SourceContact(np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0, np.uint8))
    frame, vertex, label = (np.concatenate([vars(part)[name] for part in (empty, *parts)]) for name in vars(empty))
    order = np.lexsort((vertex, frame)) if by_columns else slice(None)
    return SourceContact(frame[order], vertex[order], label[order])
