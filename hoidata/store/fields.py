"""Schema of a store: all fields of its files. The writer, the checker and README.md use this table.

A store of another schema version is refused: convert its raw files again.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from hoidata.clips.clip import SIDES
from hoidata.hands.model import N_VERTICES

SCHEMA_VERSION = "1.1.0"
UNITS = {"length": "metre", "angle": "radian", "time": "second"}


@dataclass(frozen=True)
class Field:
    """One member of an array file, one column of a table, or one key of info.json."""

    name: str
    dtype: str  # of NumPy, Parquet or JSON
    meaning: str
    shape: tuple[int | str, ...] = ()  # length of each axis, or a name if the length varies; () is a single value
    axes: tuple[str, ...] = ()  # what each axis counts; by default the names in ``shape``
    unit: str = ""
    frame: str = ""  # frame of reference of coordinates
    required: bool = True  # never null in a table or in info.json; members of arrays are never absent
    choices: tuple[str, ...] = ()  # the allowed texts

    def __post_init__(self) -> None:
        object.__setattr__(self, "axes", self.axes or tuple(name for name in self.shape if isinstance(name, str)))

    @property
    def row_shape(self) -> tuple[int, ...]:
        """Shape of one row: all axes but the first."""
        return tuple(length for length in self.shape[1:] if isinstance(length, int))


@dataclass(frozen=True)
class StoreFile:
    """One file of a store, or one file per shard (``frames-*.npz``)."""

    path: str
    meaning: str
    order: str  # order of its rows or members
    fields: tuple[Field, ...]


def _both(field: Field) -> tuple[Field, ...]:
    """Return the field for both hands: ``<side>`` in its name and meaning becomes left and right."""
    texts = [(field.name.replace("<side>", side), field.meaning.replace("<side>", side)) for side in SIDES]
    return tuple(replace(field, name=name, meaning=meaning) for name, meaning in texts)


def _array(
    name: str, dtype: str, axes: str, meaning: str, unit: str = "", frame: str = "", required: bool = True
) -> Field:
    """A field with axes. axes: what each counts, and its length if that is fixed: ``frame, xyz:3``."""
    parts = [axis.partition(":") for axis in axes.split(", ")]
    shape, counts = tuple(int(length or 0) or count for count, _, length in parts), tuple(part[0] for part in parts)
    return Field(name, dtype, meaning, shape, axes=counts, unit=unit, frame=frame, required=required)


def _rotvec(name: str, rows: str, meaning: str) -> Field:
    return _array(name, "float32", f"{rows}, axis-angle:3", meaning, "radian", "world")


def _point(name: str, rows: str, meaning: str) -> Field:
    return _array(name, "float32", f"{rows}, xyz:3", meaning, "metre", "world")


def _angles(name: str, rows: str, joints: int, meaning: str) -> Field:
    return _array(name, "float32", f"{rows}, joint x axis-angle:{3 * joints}", meaning, "radian", "parent joint")


def _hand(side: str) -> tuple[Field, ...]:
    untracked = "False: the hand is not tracked; its numbers are finite but meaningless"
    shape, axes = (f"{side} betas row", 10), ("betas row", "component")
    return (
        _point(f"{side}_wrist_m", "frame", f"position of joint 0 of the {side} hand; not MANO's transl"),
        _rotvec(f"{side}_global_orient", "frame", f"rotation of the {side} hand about its wrist joint"),
        _angles(f"{side}_hand_pose", "frame", 15, f"finger joints of the {side} hand, absolute: zero is flat"),
        _array(f"{side}_valid", "bool", "frame", untracked),
        Field(f"{side}_betas", "float32", "MANO shape", shape, axes),
    )


def _object_fields(prefix: str, rows: str, target: str) -> tuple[Field, ...]:
    hinge = f"unwrapped hinge angle of {target}; metres of a prismatic joint; 0 for rigid ones"
    return (
        _rotvec(f"{prefix}_rotvec", rows, f"world_from_object of {target}, column vectors"),
        _point(f"{prefix}_translation_m", rows, f"origin of the object frame of {target}"),
        _array(f"{prefix}_hinge_rad", "float32", rows, hinge, "radian", "object"),
    )


FRAMES = StoreFile(
    "arrays/frames-*.npz",
    "motion; one file per shard, numbered from 00000",
    "clips of a shard one after another, in the order of sequences.parquet",
    (
        _array("source_frames", "int32", "frame", "index in the source file, from 0, rising"),
        *_hand("left"),
        *_hand("right"),
        *_object_fields("object", "frame", "the manipulated object"),
        *_object_fields("other", "other object x frame", "the further objects, one after another"),
        _rotvec("camera_rotvec", "camera row", "world_from_camera, OpenCV axes (x right, y down, z ahead)"),
        _point("camera_position_m", "camera row", "position of the camera"),
        _array("camera_images", "int32", "camera row", "number of the image in the source"),
    ),
)

BODY = StoreFile(
    "arrays/body-*.npz",
    "SMPL-X body parameters of the source; only for shards with a clip that has them",
    "clips of a shard one after another",
    (
        _point("transl_m", "body row", "SMPL-X transl"),
        _rotvec("global_orient", "body row", "SMPL-X global orientation"),
        _angles("body_pose", "body row", 21, "SMPL-X body joints"),
        _angles("face_pose", "body row", 3, "jaw, left eye, right eye"),
        _array("expression", "float32", "expression row, component:10", "SMPL-X"),
    ),
)

SOURCE_CONTACT = StoreFile(
    "arrays/source_contact-*.npz",
    "contact labels of the source, one row per touched vertex and frame; only for shards with a clip that has them",
    "clips of a shard one after another; within a clip by frame, then vertex",
    (
        _array("frame", "int32", "entry", "frame of the clip, from 0"),
        _array("vertex", "int32", "entry", "vertex of the clip's object mesh"),
        _array("label", "uint8", "entry", "number of the touching body part, in the numbering of the source"),
    ),
)

OBJECT_ARRAYS = StoreFile(
    "arrays/objects.npz",
    "canonical meshes; every member is called <object>/<name>",
    "alphabetical",
    (
        _array("vertices_m", "float64", "vertex, xyz:3", "hinge at zero", "metre", "object"),
        _array("faces", "int32", "face, corner:3", "vertices of each triangle"),
        _array("part", "uint8", "vertex", "0 base, 1 the part the hinge moves"),
    ),
)

TEMPLATES = StoreFile(
    "arrays/templates.npz",
    "personal rest meshes; a member's name is the start of the SHA-256 of its bytes",
    "alphabetical",
    (_array("<template>", "float32", f"vertex:{N_VERTICES}, xyz:3", "replaces MANO's template", "metre", "hand"),),
)


_CHAIN = "world_from_wrist of the <side> hand, then joints relative to their parents"
_TURNS = "frame, joint, axis-angle:3"
RECORDINGS = StoreFile(
    "arrays/recordings.npz",
    "whole recordings at the frame rate and with the hand joints of the source, if info.json lists any under "
    "recordings; every member is called <sequence>/<name>",
    "alphabetical",
    (
        *_both(_point("<side>_wrist_m", "frame", "position of the <side> wrist")),
        *_both(_array("<side>_rotvec", "float32", _TURNS, _CHAIN, "radian", "parent joint")),
        _rotvec("object_rotvec", "frame", "world_from_object, column vectors"),
        _point("object_translation_m", "frame", "origin of the object frame"),
        _array("object_hinge_rad", "float32", "frame", "as in frames-*.npz; 0 for rigid ones", "radian", "object"),
        _array("usable", "bool", "frame", "False: tracking failed"),
    ),
)


def _of_hand(name: str, rows: str, meaning: str, frame: str = "joint", unit: str = "metre") -> Field:
    return _array(name, "float64", f"{rows}, xyz:3", meaning, unit, frame)


_CANONICAL = "columns: to the fingers, to the thumb, out of the back"
SOURCE_HANDS = StoreFile(
    "arrays/source_hands.npz",
    "the right hands of recordings.npz: skeleton, sensing skin, capsules; every member is called <hand>/<name>, "
    "and info.json names layout and joints under source_hands",
    "alphabetical",
    (
        _array("parents", "int64", "joint", "parent joint; -1 for the wrist, the first joint"),
        _of_hand("offset_m", "joint", "from the parent", "parent joint"),
        _array("rest_rotmats", "float64", "finger joint, row:3, column:3", "neutral pose, relative to parents"),
        _of_hand("skin_point_m", "skin point", "the five tips, then the proximity sensors, at rest", "skin"),
        _of_hand("skin_normal", "skin point", "outward", "skin", ""),
        _array("skin_weight", "float64", "skin point, joint", "of linear blend skinning"),
        _array("joint_from_skin", "float64", "joint, row:3, column:3", "rotations at rest"),
        _of_hand("joint_from_skin_m", "joint", "the skin frame's origin at rest"),
        _array("tip_joint", "int64", "finger", "last joint of each finger"),
        _array("capsule_joint", "int64", "capsule", "joint that each capsule moves with"),
        _of_hand("capsule_start_m", "capsule", "centre of the first sphere"),
        _of_hand("capsule_end_m", "capsule", "centre of the last sphere"),
        _array("capsule_radius_m", "float64", "capsule", "of the spheres", "metre"),
        _array("wrist_from_canonical", "float64", "row:3, column:3", _CANONICAL),
        _of_hand("hinge_axis", "joint", "unit vector; zero for ball joints", unit=""),
        _array("limit_rad", "float64", "joint, value:2", "minimum and maximum angle from the neutral pose", "radian"),
    ),
)

_TEXT, _WHOLE, _ROW = "string", "int32", "int64"
_TO_SOURCE = "homogeneous matrix, row by row: to the frame and unit of the source"
_GRAVITY_NOTE = "how gravity was estimated, or why it is unknown; empty if the source states it"
_FIT_ERROR = "mean error of hands fitted to keypoints; null for parameters"
_LENS = "fx, fy, cx, cy, width, height"
_TEMPLATE = "member of templates.npz, null for the template of MANO"


def _rows_of(name: str, array: str, optional: bool = False) -> Field:
    return Field(name, _ROW, f"first row of {array}{'; -1 for a clip without' if optional else ''}")


SEQUENCES = StoreFile(
    "meta/sequences.parquet",
    "one row per clip",
    "as written; a conversion writes sequences by key, and the clips of a sequence in the order of their frames",
    (
        Field("clip_id", _TEXT, "unique; consists of names of the source, not of positions in a list"),
        Field("dataset", _TEXT, "name of the dataset"),
        Field("subject", _TEXT, "as in the source"),
        Field("sequence", _TEXT, "the source sequence it was cut from"),
        Field("verb", _TEXT, "the action; null without a label", required=False),
        Field("object_words", _TEXT, "noun of the object, without article"),
        Field("labelled_hand", _TEXT, "the hand an annotator named", required=False, choices=("left", "right", "both")),
        Field("object", _TEXT, "the manipulated object: its row in objects.parquet"),
        _array("other_objects", _TEXT, "other object", "further objects of the scene"),
        Field("n_frames", _WHOLE, "frames at 30 per second"),
        Field("shard", _WHOLE, "number of its frames-, body- and source_contact- file"),
        _rows_of("first_row", "the frame arrays"),
        Field("articulated", "bool", "whether the object has a hinge"),
        *_both(_rows_of("<side>_betas_row", "<side>_betas")),
        *_both(Field("<side>_betas_count", _WHOLE, "rows of <side>_betas: 1, or one per frame")),
        *_both(Field("<side>_template", _TEXT, _TEMPLATE, required=False)),
        *_both(Field("<side>_valid_frames", _WHOLE, "how many frames of <side>_valid are True")),
        _rows_of("other_row", "the other_ arrays; object k follows k * n_frames later"),
        _array("gravity", "float64", "xyz:3", "unit vector of gravity; null if unknown", frame="world", required=False),
        _array("source_from_world", "float64", "row x column:16", _TO_SOURCE),
        Field("source_fps", "float64", "rate of the source file", unit="1 / second"),
        Field("first_source_frame", _WHOLE, "first of source_frames"),
        Field("last_source_frame", _WHOLE, "last of source_frames"),
        _array("source_files", _WHOLE, "file", "rows of files.parquet it was read from"),
        Field("synthetic", "bool", "whether the raw data was generated"),
        Field("gravity_note", _TEXT, _GRAVITY_NOTE),
        Field("hands_from", _TEXT, "what the source provides", choices=("parameters", "keypoints")),
        Field("fit_error_m", "float64", _FIT_ERROR, unit="metre", required=False),
        Field("camera_name", _TEXT, "as in the source; null without a camera", required=False),
        _array("camera_intrinsics", "float64", "value:6", _LENS, "pixel", required=False),
        _rows_of("camera_row", "the camera_ arrays", optional=True),
        _rows_of("body_row", "the arrays of body-*.npz", optional=True),
        _rows_of("expression_row", "expression in body-*.npz", optional=True),
        _rows_of("source_contact_row", "the arrays of source_contact-*.npz", optional=True),
        Field("source_contact_count", _ROW, "how many rows; 0 for a clip without"),
    ),
)

_ORIGIN = "a point of the hinge; null when rigid or prismatic"
OBJECTS = StoreFile(
    "meta/objects.parquet",
    "one row per object",
    "by object",
    (
        Field("object", _TEXT, "unique; <name>#<start of digest> where meshes of one name differ"),
        Field("n_vertices", _WHOLE, "vertices"),
        Field("n_faces", _WHOLE, "triangles"),
        Field("articulated", "bool", "whether it has a hinge"),
        _array("hinge_axis", "float64", "xyz:3", "unit vector; null when rigid", frame="object", required=False),
        _array("hinge_origin_m", "float64", "xyz:3", _ORIGIN, "metre", "object", required=False),
        Field("digest", _TEXT, "SHA-256 of vertices_m, faces, part, hinge_axis and hinge_origin_m, in that order"),
    ),
)

FILES = StoreFile(
    "meta/files.parquet",
    "one row per raw file",
    "by first use",
    (
        Field("path", _TEXT, "below the raw root; a folder of small files counts as one"),
        Field("size", "int64", "of the file", unit="byte"),
        Field("sha256", _TEXT, "of its bytes; of a folder: of one line '<sha256>  <name>' per file"),
    ),
)

QUARANTINE = StoreFile(
    "meta/quarantine.parquet",
    "rejected sequences and clips",
    "as written",
    (
        Field("source_key", _TEXT, "the sequence, or the clip"),
        Field("where", _TEXT, "the file or field"),
        Field("expected", _TEXT, "the requirement"),
        Field("got", _TEXT, "the value in the file"),
        Field("remedy", _TEXT, "what to do"),
    ),
)

INFO = StoreFile(
    "meta/info.json",
    "facts of the whole store; a dot separates nested keys; further keys are allowed, conversions add some",
    "alphabetical",
    (
        Field("schema_version", "string", "major.minor.patch"),
        Field("dataset", "string", "name of the dataset, lower case"),
        Field("dataset_version", "string", "release the adapter reads"),
        Field("synthetic", "boolean", "whether the raw data was generated"),
        Field("fps", "number", "of every clip", unit="1 / second"),
        Field("source_fps", "number", "of the raw files", unit="1 / second"),
        Field("units.length", "string", "metre"),
        Field("units.angle", "string", "radian"),
        Field("units.time", "string", "second"),
        Field("axes", "object", "what the axes of each member of frames-*.npz count"),
        Field("frame.handedness", "string", "of the world frame", choices=("right",)),
        Field("frame.up_axis", "string", "null if the source does not state it", required=False,
              choices=("+x", "-x", "+y", "-y", "+z", "-z")),
        Field("frame.gravity", "string", "source of gravity", choices=("stated", "estimated", "unknown")),
        Field("frame.note", "string", "one sentence for people"),
        Field("hand_model.name", "string", "mano, or embedded"),
        Field("hand_model.digest", "string", "SHA-256 of the hand model the parameters belong to"),
        Field("hand_convention.left_shape", "string", "sign of the left hand's shape directions in the source",
              choices=("as released", "corrected", "unused", "unknown")),
        Field("hand_convention.note", "string", "meaning of the hand parameters of the source"),
        Field("licence", "string", "of the raw data"),
        Field("may_be_shared", "boolean", "whether the licence allows sharing derived data"),
        Field("counts.clips", "integer", "rows of sequences.parquet"),
        Field("counts.frames", "integer", "sum of n_frames"),
        Field("counts.objects", "integer", "rows of objects.parquet"),
        Field("counts.files", "integer", "rows of files.parquet"),
        Field("counts.quarantined", "integer", "rows of quarantine.parquet"),
    ),
)  # fmt: skip

TABLES = {"sequences": SEQUENCES, "objects": OBJECTS, "files": FILES, "quarantine": QUARANTINE}
STORE_FILES = (INFO, *TABLES.values(), FRAMES, BODY, SOURCE_CONTACT, OBJECT_ARRAYS, TEMPLATES, RECORDINGS,
               SOURCE_HANDS)  # fmt: skip
_UNPAIRED = [field for field in FRAMES.fields if not field.name.startswith("right_")]
AXES = {field.name.replace("left_", "<side>_"): list(field.axes) for field in _UNPAIRED}

_ARROW = {
    "string": pa.string(), "bool": pa.bool_(), "int32": pa.int32(), "int64": pa.int64(), "float64": pa.float64(),
}  # fmt: skip


def arrow_schema(file: StoreFile) -> pa.Schema:
    """Return the Parquet schema of a table; fields with an axis are lists."""
    return pa.schema([(f.name, pa.list_(_ARROW[f.dtype]) if f.shape else _ARROW[f.dtype]) for f in file.fields])


def empty_array(field: Field) -> np.ndarray:
    """Return an array of the field with no rows."""
    return np.zeros((0, *field.row_shape), field.dtype)


def value_at(info: Any, name: str) -> Any:
    """Return the value of a dotted key of info.json. Raises KeyError if it is missing."""
    for key in name.split("."):
        if not isinstance(info, dict) or key not in info:
            raise KeyError(name)
        info = info[key]
    return info
