"""GRAB (Taheri et al. 2020): one NPZ per sequence at 120 Hz, personal hand meshes, objects posed with row vectors.

Its contact labels say who touches which vertex of the object in which frame: 0 for none, 21 and 22 for the left and
right hand, 26 to 40 and 41 to 55 for their fingers. Filed as 64-bit numbers for 4,500 frames and 48,370 vertices they
take 1.7 GB, so they are read in pieces of a few megabytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS, SIDES, BodyTrack, Clip, HandTrack, ObjectTrack, Side, SourceContact, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_beside
from hoidata.datasets import checks
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
from hoidata.datasets.grab.words import object_words, verb_words
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.errors import BadInput
from hoidata.files import load_npz_objects
from hoidata.files.array_pieces import StoredArray, locate_arrays, npz_members
from hoidata.geometry.rotations import canonical_rotvec
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel

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
        "meshes of objects and table",
        ("tools/object_meshes/*/*.ply", "GRAB/tools/object_meshes/*/*.ply"),
        "object_meshes.zip",
    ),
    DatasetPart(
        "the subjects' hand meshes",
        ("tools/subject_meshes/*/*.ply", "GRAB/tools/subject_meshes/*/*.ply"),
        "tools__subject_meshes.zip",
    ),
)
MEMBERS = ("obj_name", "motion_intent", "framerate", "n_frames", "lhand", "rhand", "object")
MOST_COMPONENTS = 45


@dataclass(frozen=True)
class GrabAdapter(Described):
    """Raw root: ``grab/sN/<object>_<action>_<n>.npz`` and ``tools/`` beside it, as the official unzip leaves them.

    margin_frames: frames (of 30 fps) kept before the first and after the last frame with contact.
    contact: keep GRAB's own contact labels (9 bytes per touched vertex and frame: about 10 MB per clip of real data).
    body: keep the parameters of the person's SMPL-X body.
    """

    facts = facts_beside(__file__)
    margin_frames: int = 0
    contact: bool = True
    body: bool = False
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
        file = _open(raw, key, self.body)
        model = _mesh_model(raw, file.text("obj_name"), file.beside("object", "object_mesh"))
        step = file.fps // FPS
        contact = read_contact(file.place, file.path, file.n_frames, len(model.vertices_m), step, self.contact)
        start, stop = _contact_range(file, contact.touched, self.margin_frames)
        frames = np.arange(start * step, stop * step, step)
        clip = Clip(
            clip_id=str(key),
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
            hands={side: _hand(raw, file, side, frames, hands) for side in SIDES},
            object=_object_track(file, "object", model, frames),
            other_objects=_table(raw, file, frames),
            source_frames=frames.astype(np.int32),
            gravity=np.array([0.0, 0.0, -1.0]),
            verb=verb_words(file.text("motion_intent")),
            object_words=object_words(model.name),
            source_fps=float(file.fps),
            source_contact=contact.cut(start, stop),
            body=_body(file).take(frames) if self.body else None,
        )
        return [replace(clip, sources=raw.sources)]


@dataclass(frozen=True)
class _SequenceFile:
    """The entries of one NPZ but for its contact labels.

    top: the folder that holds ``grab/`` and ``tools/``; path: of the file below the raw root; place: where it lies.
    """

    top: str
    path: str
    place: Path
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


def _open(raw: RawTree, key: SequenceKey, with_body: bool) -> _SequenceFile:
    top = next((top for top in ROOTS if raw.has(_below(top, f"grab/{key.name}.npz"))), ROOTS[0])
    path = _below(top, f"grab/{key.name}.npz")
    place = raw.file(path)
    optional = npz_members(place) & {"table"}
    members = {*MEMBERS, *optional, *(("body",) if with_body else ())}
    return _SequenceFile(top, path, place, load_npz_objects(place, members))


def _below(top: str, path: str) -> str:
    return f"{top}/{path}" if top else path


def _contact_range(file: _SequenceFile, touched: np.ndarray, margin: int) -> tuple[int, int]:
    """First kept frame and the one after the last, in frames of 30 fps: cut to the contact, both ends included."""
    frames = np.flatnonzero(touched)
    if not len(frames):
        remedy = "nothing to do: nobody touches the object"
        raise BadInput(f"{file.path}: contact.object", "contact in at least one frame", "none", remedy)
    return max(0, int(frames[0]) - margin), min(len(touched), int(frames[-1]) + 1 + margin)


def _object_track(file: _SequenceFile, member: str, model: ObjectModel, frames: np.ndarray) -> ObjectTrack:
    """GRAB poses objects as x_world = x R + t with row vectors: the column-vector rotation is the transpose."""
    where, pose = f"{file.path}: {member}", file.params(member)
    orient = checks.table(f"{where}.global_orient", pose["global_orient"], 3, file.n_frames)[frames]
    transl = checks.table(f"{where}.transl", pose["transl"], 3, file.n_frames)[frames]
    return ObjectTrack(model, -canonical_rotvec(orient).astype(np.float32), transl.astype(np.float32))


def _table(raw: RawTree, file: _SequenceFile, frames: np.ndarray) -> tuple[ObjectTrack, ...]:
    """The table the object lies on, where the file has one and its mesh was downloaded."""
    if "table" not in file.data or not raw.has(mesh := file.beside("table", "table_mesh")):
        return ()
    return (_object_track(file, "table", _mesh_model(raw, "table", mesh), frames),)


def _body(file: _SequenceFile) -> BodyTrack:
    return checks.body_track(f"{file.path}: body", file.params("body"), file.n_frames, {"expression": 10})


def _hand(raw: RawTree, file: _SequenceFile, side: Side, frames: np.ndarray, hands: HandPair) -> HandTrack:
    member = {"left": "lhand", "right": "rhand"}[side]
    where, params = f"{file.path}: {member}", file.params(member)
    template = _template(raw, file.beside(member, "vtemp"))
    orient = checks.table(f"{where}.global_orient", params["global_orient"], 3, file.n_frames)
    transl = checks.table(f"{where}.transl", params["transl"], 3, file.n_frames)
    fingers, convention = _fingers(where, params, file.n_frames)
    source = SourceHand(
        translation_m=transl[frames],
        global_orient=orient[frames],
        fingers=fingers[frames],
        betas=np.zeros((1, 10)),  # the personal mesh already has the subject's shape
        template_m=template,
    )
    return to_track(source, convention, hands[side])


def _fingers(where: str, params: Mapping[str, Any], n_frames: int) -> tuple[np.ndarray, HandConvention]:
    """Finger angles ``fullpose`` (frame, 45), or without them however many principal components there are."""
    if "fullpose" in params:
        return checks.table(f"{where}.fullpose", params["fullpose"], 45, n_frames), CONVENTION
    coefficients = np.asarray(checks.entry(where, params, "hand_pose"))
    columns = coefficients.shape[1] if coefficients.ndim == 2 else 0
    columns = columns if 1 <= columns <= MOST_COMPONENTS else 24
    pose = checks.table(f"{where}.hand_pose", coefficients, columns, n_frames)
    return pose, replace(CONVENTION, components=columns)


def _template(raw: RawTree, path: str) -> np.ndarray:
    vertices = raw_mesh(raw, path).vertices
    if vertices.shape != (778, 3):
        raise BadInput(path, "a hand mesh of 778 vertices", f"{len(vertices)}")
    return vertices


def _mesh_model(raw: RawTree, name: str, path: str) -> ObjectModel:
    mesh = raw_mesh(raw, path)
    return ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), dtype=np.uint8))


MOST_LABELS = 32_000_000  # 290 MB; a hand around a fine mesh touches some 6,000 vertices, a tenth of this in 500 frames
_LARGEST_LABEL = 255


@dataclass(frozen=True)
class ContactLabels:
    """Labels of every step-th frame. touched: (kept frame,) bool; labels: their entries, None when not asked for."""

    touched: np.ndarray
    labels: SourceContact | None

    def cut(self, start: int, stop: int) -> SourceContact | None:
        """The entries of the kept frames ``start`` to ``stop`` (exclusive), counted from ``start``."""
        if self.labels is None:
            return None
        first, last = np.searchsorted(self.labels.frame, (start, stop))
        part = slice(first, last)
        return SourceContact(
            self.labels.frame[part] - np.int32(start), self.labels.vertex[part], self.labels.label[part]
        )


def read_contact(
    place: Path, where: str, n_frames: int, n_vertices: int, step: int, with_labels: bool
) -> ContactLabels:
    """The contact labels of every ``step``-th frame from frame 0 on.

    place: of the NPZ; where: names it in errors. n_frames: as the file says; n_vertices: of the object's mesh.
    with_labels: keep every entry, not only whether a frame has one. Raises BadInput for anything else.
    """
    where = f"{where}: contact.object"
    array = locate_arrays(place, "contact").get("object")
    if array is None or array.shape != (n_frames, n_vertices):
        expected = f"numbers of shape ({n_frames}, {n_vertices}): frames, vertices of the contact mesh"
        raise BadInput(where, expected, "none" if array is None else f"{array.dtype} of shape {array.shape}")
    touched = np.zeros(len(range(0, n_frames, step)), dtype=bool)
    kept: list[SourceContact] = []
    n_kept = 0
    for found in map(lambda piece: _labels_of(where, array, step, *piece), array.pieces()):
        touched[found.frame] = True
        n_kept += len(found.frame)
        if with_labels:
            if n_kept > MOST_LABELS:
                raise BadInput(
                    where, f"at most {MOST_LABELS} labels", "more", "convert with the setting contact: false"
                )
            kept.append(found)
    return ContactLabels(touched, _joined(kept, array.by_columns) if with_labels else None)


def _labels_of(where: str, array: StoredArray, step: int, first: int, piece: np.ndarray) -> SourceContact:
    """The labels of one piece, frames counted in steps. first: number of the piece's first row (or column)."""
    if array.by_columns:
        vertex, frame = np.nonzero(_checked(where, piece[:, ::step]))
        label = piece[:, ::step][vertex, frame]
        vertex = vertex + first
    else:
        skipped = -first % step
        rows = piece[skipped::step]
        frame, vertex = np.nonzero(_checked(where, rows))
        label = rows[frame, vertex]
        frame = frame + (first + skipped) // step
    return SourceContact(frame.astype(np.int32), vertex.astype(np.int32), label.astype(np.uint8))


def _checked(where: str, labels: np.ndarray) -> np.ndarray:
    """Which of them say contact. Raises BadInput unless all are whole numbers a label can be; below 0 is none."""
    if not labels.size:
        return labels > 0
    if labels.dtype.kind == "f" and not (np.isfinite(labels).all() and (labels == np.rint(labels)).all()):
        raise BadInput(where, "whole numbers", "fractions, NaN or infinity")
    if labels.max() > _LARGEST_LABEL:
        raise BadInput(where, f"labels up to {_LARGEST_LABEL}", f"{labels.max()}")
    return labels > 0


def _joined(parts: list[SourceContact], by_columns: bool) -> SourceContact:
    """One array of each kind, sorted by frame, then vertex. Empties ``parts`` on the way: they are not held twice."""
    n_labels = sum(len(part.frame) for part in parts)
    whole = SourceContact(*(np.empty(n_labels, dtype) for dtype in (np.int32, np.int32, np.uint8)))
    stop = n_labels
    while parts:
        part = parts.pop()
        start = stop - len(part.frame)
        whole.frame[start:stop], whole.vertex[start:stop], whole.label[start:stop] = part.frame, part.vertex, part.label
        stop = start
    if not by_columns:
        return whole
    order = np.lexsort((whole.vertex, whole.frame))
    return SourceContact(whole.frame[order], whole.vertex[order], whole.label[order])
