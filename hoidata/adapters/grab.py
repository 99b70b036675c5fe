"""GRAB (Taheri et al. 2020): one NPZ per sequence at 120 Hz, personal hand meshes, objects posed with row vectors."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.adapters import checks
from hoidata.adapters.base import DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.files import load_npz_objects
from hoidata.hands import HandPair
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import ObjectModel
from hoidata.schema.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side, WorldFrame
from hoidata.schema.hand_parameters import HandConvention, SourceHand, to_track

VERBS = {"offhand": "hand over", "switchON": "switch on", "takepicture": "take picture"}  # all others are words already
OBJECT_WORDS = {
    "alarmclock": "alarm clock",
    "fryingpan": "frying pan",
    "gamecontroller": "game controller",
    "lightbulb": "light bulb",
    "piggybank": "piggy bank",
    "stanfordbunny": "Stanford bunny",
    "waterbottle": "water bottle",
    "wineglass": "wine glass",
    "coffeemug": "coffee mug",
    "rubberduck": "rubber duck",
    "cubemiddle": "middle cube",
}
SIZED_SHAPE = re.compile(r"(cube|cylinder|pyramid|sphere|torus)(large|medium|small)")
ROOTS = ("", "GRAB")
FRAME = WorldFrame("+z", "stated", "GRAB's motion-capture world, right-handed, z up, metres")
CONVENTION = HandConvention(
    translation="transl",
    fingers="absolute",
    shape="personal mesh",
    left_shape="unused",
    note="MANO: absolute axis-angles, the subject's own rest mesh without betas, translation added to its rest wrist",
)
PARTS = (
    DatasetPart("sequences", ("grab/s*/*.npz", "GRAB/grab/s*/*.npz"), "grab__s1.zip to grab__s10.zip"),
    DatasetPart(
        "object meshes",
        ("tools/object_meshes/contact_meshes/*.ply", "GRAB/tools/object_meshes/contact_meshes/*.ply"),
        "object_meshes.zip",
    ),
    DatasetPart(
        "the subjects' hand meshes",
        ("tools/subject_meshes/*/*_rhand.ply", "GRAB/tools/subject_meshes/*/*_rhand.ply"),
        "tools__subject_meshes.zip",
    ),
)
MEMBERS = ("obj_name", "motion_intent", "framerate", "n_frames", "lhand", "rhand", "object", "contact")


@dataclass(frozen=True)
class GrabAdapter:
    """Raw root: ``grab/sN/<object>_<action>_<n>.npz`` and ``tools/`` beside it, as the official unzip leaves them.

    margin_frames: frames (of 30 fps) kept before the first and after the last frame with contact.
    """

    margin_frames: int = 0
    name: str = "grab"
    version: str = "1.0"
    licence: str = "GRAB licence (MPI): non-commercial research, no redistribution"
    where_to_register: str = "https://grab.is.tue.mpg.de (GRAB parts and object_meshes.zip)"
    needs_mano: bool = True
    source_fps: float = 120.0
    may_be_shared: bool = False
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per ``grab/sN/*.npz``."""
        found = {path for top in ROOTS for path in (Path(root) / top / "grab").glob("s*/*.npz")}
        keys = {SequenceKey(self.name, path.parent.name, f"{path.parent.name}/{path.stem}") for path in found}
        return sorted(keys)

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip: every 4th frame, from the first to the last of them with object contact, both included."""
        file = _open(raw, key)
        model = _object_model(raw, file)
        contact = _contact(file, len(model.vertices_m))
        frames = _contact_range(file, contact, self.margin_frames)
        pose = file.params("object")
        orient = checks.table(f"{file.path}: object.global_orient", pose["global_orient"], 3, file.n_frames)[frames]
        transl = checks.table(f"{file.path}: object.transl", pose["transl"], 3, file.n_frames)[frames]
        intent = file.text("motion_intent")
        clip = Clip(
            clip_id=str(key),
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
            hands={side: _hand(raw, file, side, frames, hands) for side in SIDES},
            # GRAB poses objects as x_world = x R + t with row vectors: the column-vector rotation is the transpose.
            object=ObjectTrack(model, -orient.astype(np.float32), transl.astype(np.float32)),
            source_frames=frames.astype(np.int32),
            gravity=np.array([0.0, 0.0, -1.0]),
            verb=VERBS.get(intent, intent),
            object_words=object_words(model.name),
            source_fps=float(file.fps),
        )
        return [replace(clip, sources=raw.sources)]


@dataclass(frozen=True)
class _SequenceFile:
    """The entries of one NPZ. top: the folder that holds ``grab/`` and ``tools/``; path: of the file below the root."""

    top: str
    path: str
    data: dict[str, Any]

    @property
    def n_frames(self) -> int:
        return self._count("n_frames")

    @property
    def fps(self) -> int:
        fps = self._count("framerate")
        if fps % FPS:
            raise BadInput(f"{self.path}: framerate", f"a multiple of {FPS} frames per second", f"{fps}")
        return fps

    def params(self, member: str) -> Mapping[str, Any]:
        """``member.params``, known to hold ``global_orient`` and ``transl``."""
        params = checks.entry(f"{self.path}: {member}", checks.entry(self.path, self.data, member), "params")
        for name in ("global_orient", "transl"):
            checks.entry(f"{self.path}: {member}.params", params, name)
        return params

    def text(self, *keys: str) -> str:
        value: Any = self.data
        for key in keys:
            value = checks.entry(self.path, value, key)
        if not isinstance(value, str):
            raise BadInput(f"{self.path}: {'.'.join(keys)}", "text", type(value).__name__)
        return str(value)

    def beside(self, *keys: str) -> str:
        """The path named by a text entry, which counts from the folder that holds ``grab/`` and ``tools/``."""
        return _below(self.top, self.text(*keys))

    def _count(self, key: str) -> int:
        value = np.asarray(checks.entry(self.path, self.data, key))
        if value.shape or value.dtype.kind not in "fiu" or not 1 <= value < np.inf or value != round(float(value)):
            raise BadInput(f"{self.path}: {key}", "a whole number of 1 or more", repr(value)[:40])
        return int(value)


def _open(raw: RawTree, key: SequenceKey) -> _SequenceFile:
    top = next((top for top in ROOTS if raw.has(_below(top, f"grab/{key.name}.npz"))), ROOTS[0])
    path = _below(top, f"grab/{key.name}.npz")
    return _SequenceFile(top, path, load_npz_objects(raw.file(path), MEMBERS))


def object_words(name: str) -> str:
    """GRAB's joined object name in words, size first: ``cubelarge`` is "large cube"."""
    sized = SIZED_SHAPE.fullmatch(name)
    return f"{sized[2]} {sized[1]}" if sized else OBJECT_WORDS.get(name, name)


def _below(top: str, path: str) -> str:
    return f"{top}/{path}" if top else path


def _contact(file: _SequenceFile, n_vertices: int) -> np.ndarray:
    """(frame,) bool: any object vertex touched."""
    labels = np.asarray(checks.entry(file.path, checks.entry(file.path, file.data, "contact"), "object"))
    if labels.dtype.kind not in "fiub" or labels.shape != (file.n_frames, n_vertices):
        expected = f"numbers of shape ({file.n_frames}, {n_vertices}): frames, vertices of the contact mesh"
        raise BadInput(f"{file.path}: contact.object", expected, f"{labels.dtype} of shape {labels.shape}")
    return np.asarray((labels > 0).any(axis=1))


def _contact_range(file: _SequenceFile, contact: np.ndarray, margin: int) -> np.ndarray:
    """Source frames at 30 fps, counted from the file's frame 0 (every 4th of 120 Hz), cut to the contact."""
    strided = np.arange(0, file.n_frames, file.fps // FPS)
    touched = np.flatnonzero(contact[strided])
    if not len(touched):
        remedy = "nothing to do: nobody touches the object"
        raise BadInput(f"{file.path}: contact.object", "contact in at least one frame", "none", remedy)
    return strided[max(0, touched[0] - margin) : touched[-1] + 1 + margin]


def _hand(raw: RawTree, file: _SequenceFile, side: Side, frames: np.ndarray, hands: HandPair) -> HandTrack:
    member = {"left": "lhand", "right": "rhand"}[side]
    where, params = f"{file.path}: {member}", file.params(member)
    template = _template(raw, file.beside(member, "vtemp"))
    orient = checks.table(f"{where}.global_orient", params["global_orient"], 3, file.n_frames)
    transl = checks.table(f"{where}.transl", params["transl"], 3, file.n_frames)
    source = SourceHand(
        translation_m=transl[frames],
        global_orient=orient[frames],
        fingers=_finger_pose(where, params, hands[side].components, file.n_frames)[frames],
        betas=np.zeros((1, 10)),  # the personal mesh already has the subject's shape
        template_m=template,
    )
    return to_track(source, CONVENTION, hands[side])


def _finger_pose(where: str, params: Mapping[str, Any], components: np.ndarray, n_frames: int) -> np.ndarray:
    """Absolute finger angles (frame, 45): ``fullpose``, or without it the principal components (flat mean)."""
    if "fullpose" in params:
        return checks.table(f"{where}.fullpose", params["fullpose"], 45, n_frames)
    coefficients = np.asarray(checks.entry(where, params, "hand_pose"))
    columns = coefficients.shape[1] if coefficients.ndim == 2 and coefficients.shape[1] <= 45 else 24
    return checks.table(f"{where}.hand_pose", coefficients, columns, n_frames) @ components[:columns]


def _template(raw: RawTree, path: str) -> np.ndarray:
    vertices = load_mesh(raw.file(path)).vertices
    if vertices.shape != (778, 3):
        raise BadInput(path, "a hand mesh of 778 vertices", f"{len(vertices)}")
    return vertices


def _object_model(raw: RawTree, file: _SequenceFile) -> ObjectModel:
    mesh = load_mesh(raw.file(file.beside("object", "object_mesh")))
    part = np.zeros(len(mesh.vertices), dtype=np.uint8)
    return ObjectModel(file.text("obj_name"), mesh.vertices, mesh.faces, part)
