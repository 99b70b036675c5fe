"""Every field of a store, once: what the writer writes, the checker checks and README.md documents.

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
    """One member of an array file, one column of a table, or one key of info.json.

    dtype: of NumPy, Parquet or JSON. shape: numbers, or names of lengths that vary; () is one value. axes: what each
    axis counts. unit: "" where there is none. frame: the frame of reference of coordinates, "" where there is none.
    required: never null (tables, info.json); members of arrays are always there. choices: the only texts allowed.
    """

    name: str
    dtype: str
    meaning: str
    shape: tuple[int | str, ...] = ()
    axes: tuple[str, ...] = ()
    unit: str = ""
    frame: str = ""
    required: bool = True
    choices: tuple[str, ...] = ()

    @property
    def row_shape(self) -> tuple[int, ...]:
        """Shape of one row: all axes but the first."""
        return tuple(length for length in self.shape[1:] if isinstance(length, int))


@dataclass(frozen=True)
class StoreFile:
    """One file of a store, or one per shard (``frames-*.npz``). order: in which order its rows or members come."""

    path: str
    meaning: str
    order: str
    fields: tuple[Field, ...]


def _both(field: Field) -> tuple[Field, ...]:
    """The field once per hand: ``<side>`` in its name and meaning becomes left and right."""
    return tuple(
        replace(field, name=field.name.replace("<side>", s), meaning=field.meaning.replace("<side>", s)) for s in SIDES
    )


def _rotvec(name: str, rows: str, meaning: str) -> Field:
    return Field(name, "float32", meaning, (rows, 3), (rows, "axis-angle"), "radian", "world")


def _point(name: str, rows: str, meaning: str) -> Field:
    return Field(name, "float32", meaning, (rows, 3), (rows, "xyz"), "metre", "world")


def _angles(name: str, rows: str, joints: int, meaning: str) -> Field:
    axes = (rows, "joint x axis-angle")
    return Field(name, "float32", meaning, (rows, 3 * joints), axes, "radian", "parent joint")


def _hand(side: str) -> tuple[Field, ...]:
    betas = Field(f"{side}_betas", "float32", "MANO shape", (f"{side} betas row", 10), ("betas row", "component"))
    return (
        _point(f"{side}_wrist_m", "frame", f"where joint 0 of the {side} hand is; not MANO's transl"),
        _rotvec(f"{side}_global_orient", "frame", f"the {side} hand turns about its wrist joint"),
        _angles(f"{side}_hand_pose", "frame", 15, f"finger joints of the {side} hand, absolute: zero is flat"),
        Field(f"{side}_valid", "bool", "False: finite numbers that mean nothing", ("frame",), ("frame",)),
        betas,
    )


def _object(prefix: str, rows: str, what: str) -> tuple[Field, ...]:
    hinge = f"unwrapped hinge angle of {what}; 0 for rigid ones"
    return (
        _rotvec(f"{prefix}_rotvec", rows, f"world_from_object of {what}, column vectors"),
        _point(f"{prefix}_translation_m", rows, f"origin of the object frame of {what}"),
        Field(f"{prefix}_hinge_rad", "float32", hinge, (rows,), (rows,), "radian", "object"),
    )


FRAMES = StoreFile(
    "arrays/frames-*.npz",
    "motion; one file per shard, numbered from 00000",
    "clips of a shard one after another, in the order of sequences.parquet",
    (
        Field("source_frames", "int32", "index in the source file, from 0, rising", ("frame",), ("frame",)),
        *_hand("left"),
        *_hand("right"),
        *_object("object", "frame", "the manipulated object"),
        *_object("other", "other object x frame", "the further objects, one after another"),
        _rotvec("camera_rotvec", "camera row", "world_from_camera, OpenCV axes (x right, y down, z ahead)"),
        _point("camera_position_m", "camera row", "where the camera is"),
        Field("camera_images", "int32", "number of the image in the source", ("camera row",), ("camera row",)),
    ),
)  # fmt: skip

BODY = StoreFile(
    "arrays/body-*.npz",
    "SMPL-X body parameters as the source gives them; there for shards with a clip that has some",
    "clips of a shard one after another",
    (
        _point("transl_m", "body row", "SMPL-X transl"),
        _rotvec("global_orient", "body row", "SMPL-X global orientation"),
        _angles("body_pose", "body row", 21, "SMPL-X body joints"),
        _angles("face_pose", "body row", 3, "jaw, left eye, right eye"),
        Field("expression", "float32", "SMPL-X", ("expression row", 10), ("expression row", "component")),
    ),
)

SOURCE_CONTACT = StoreFile(
    "arrays/source_contact-*.npz",
    "contact labels of the source, one row per touched vertex and frame; there for shards with a clip that has some",
    "clips of a shard one after another; within a clip by frame, then vertex",
    (
        Field("frame", "int32", "frame of the clip, from 0", ("entry",), ("entry",)),
        Field("vertex", "int32", "vertex of the clip's object mesh", ("entry",), ("entry",)),
        Field("label", "uint8", "the source's own number of what touches", ("entry",), ("entry",)),
    ),
)

OBJECT_ARRAYS = StoreFile(
    "arrays/objects.npz",
    "canonical meshes; every member is called <object>/<name>",
    "members by name",
    (
        Field("vertices_m", "float64", "hinge at zero", ("vertex", 3), ("vertex", "xyz"), "metre", "object"),
        Field("faces", "int32", "vertices of each triangle", ("face", 3), ("face", "corner")),
        Field("part", "uint8", "0 base, 1 the part the hinge moves", ("vertex",), ("vertex",)),
    ),
)

TEMPLATES = StoreFile(
    "arrays/templates.npz",
    "personal rest meshes; a member's name is the start of the SHA-256 of its bytes",
    "members by name",
    (Field("<template>", "float32", "replaces MANO's template", (N_VERTICES, 3), ("vertex", "xyz"), "metre", "hand"),),
)


def _recorded(name: str, meaning: str, unit: str, frame: str = "world", joints: bool = False) -> Field:
    shape = ("frame", "joint", 3) if joints else ("frame", 3)
    axes = ("frame", "joint", "axis-angle") if joints else ("frame", "axis-angle" if unit == "radian" else "xyz")
    return Field(name, "float32", meaning, shape, axes, unit, frame)


RECORDINGS = StoreFile(
    "arrays/recordings.npz",
    "whole recordings at the source's own rate, hands with the source's own joints; there where info.json names some "
    "under recordings; every member is called <sequence>/<name>",
    "members by name",
    (
        *_both(_recorded("<side>_wrist_m", "where the <side> wrist is", "metre")),
        *_both(_recorded("<side>_rotvec", "world_from_wrist of the <side> hand, then joints relative to their parents",
                         "radian", "parent joint", joints=True)),
        _recorded("object_rotvec", "world_from_object, column vectors", "radian"),
        _recorded("object_translation_m", "origin of the object frame", "metre"),
        Field("object_hinge_rad", "float32", "0 for rigid ones", ("frame",), ("frame",), "radian", "object"),
        Field("usable", "bool", "False: tracking failed", ("frame",), ("frame",)),
    ),
)  # fmt: skip

_JOINT, _CAPSULE = ("joint",), ("capsule",)


def _of_hand(name: str, rows: str, meaning: str, frame: str = "joint", unit: str = "metre") -> Field:
    return Field(name, "float64", meaning, (rows, 3), (rows, "xyz"), unit, frame)


SOURCE_HANDS = StoreFile(
    "arrays/source_hands.npz",
    "the right hands of recordings.npz: skeleton, sensing skin, capsules; every member is called <hand>/<name>, "
    "and info.json names layout and joints under source_hands",
    "members by name",
    (
        Field("parents", "int64", "-1 for the wrist, which is first", _JOINT, _JOINT),
        _of_hand("offset_m", "joint", "from the parent", "parent joint"),
        Field("rest_rotmats", "float64", "neutral pose, relative to parents", ("finger joint", 3, 3),
              ("finger joint", "row", "column")),
        _of_hand("skin_point_m", "skin point", "the five tips, then the proximity sensors, at rest", "skin"),
        _of_hand("skin_normal", "skin point", "outward", "skin", ""),
        Field("skin_weight", "float64", "of linear blend skinning", ("skin point", "joint"), ("skin point", "joint")),
        Field("joint_from_skin", "float64", "rotations at rest", ("joint", 3, 3), ("joint", "row", "column")),
        _of_hand("joint_from_skin_m", "joint", "the skin frame's origin at rest"),
        Field("tip_joint", "int64", "last joint of each finger", ("finger",), ("finger",)),
        Field("capsule_joint", "int64", "what each moves with", _CAPSULE, _CAPSULE),
        _of_hand("capsule_start_m", "capsule", "middle of the first sphere"),
        _of_hand("capsule_end_m", "capsule", "middle of the last sphere"),
        Field("capsule_radius_m", "float64", "of the spheres", _CAPSULE, _CAPSULE, "metre"),
        Field("wrist_from_canonical", "float64", "columns: to the fingers, to the thumb, out of the back", (3, 3),
              ("row", "column")),
        _of_hand("hinge_axis", "joint", "unit, or zero for joints that turn freely", unit=""),
        Field("limit_rad", "float64", "least and most angle from the neutral pose", ("joint", 2), ("joint", "value"),
              "radian"),
    ),
)  # fmt: skip

_TEXT, _WHOLE, _ROW = "string", "int32", "int64"


def _rows_of(name: str, array: str, optional: bool = False) -> Field:
    return Field(name, _ROW, f"first row of {array}{'; -1 for a clip without' if optional else ''}")


SEQUENCES = StoreFile(
    "meta/sequences.parquet",
    "one row per clip",
    "as written; a conversion writes sequences by their key, the clips of one in the order of its frames",
    (
        Field("clip_id", _TEXT, "unique; made from the source's own names, never from a position in a list"),
        Field("dataset", _TEXT, "name of the dataset"),
        Field("subject", _TEXT, "as in the source"),
        Field("sequence", _TEXT, "the source sequence it was cut from"),
        Field("verb", _TEXT, "the action in words; null without a label", required=False),
        Field("object_words", _TEXT, "noun of the object, without article"),
        Field("labelled_hand", _TEXT, "the hand an annotator named", required=False, choices=("left", "right", "both")),
        Field("object", _TEXT, "the manipulated object: its row in objects.parquet"),
        Field("other_objects", _TEXT, "further objects of the scene", ("other object",), ("other object",)),
        Field("n_frames", _WHOLE, "frames at 30 per second"),
        Field("shard", _WHOLE, "number of its frames-, body- and source_contact- file"),
        _rows_of("first_row", "the frame arrays"),
        Field("articulated", "bool", "whether the object has a hinge"),
        *_both(_rows_of("<side>_betas_row", "<side>_betas")),
        *_both(Field("<side>_betas_count", _WHOLE, "rows of <side>_betas: 1, or one per frame")),
        *_both(Field("<side>_template", _TEXT, "member of templates.npz, null for MANO's own", required=False)),
        *_both(Field("<side>_valid_frames", _WHOLE, "how many frames of <side>_valid are True")),
        _rows_of("other_row", "the other_ arrays; object k follows k * n_frames later"),
        Field(
            "gravity", "float64", "unit vector in which things fall; null when not known", (3,), ("xyz",), "", "world",
            required=False,
        ),
        Field(
            "source_from_world", "float64", "homogeneous, by rows: to the source's own frame and unit", (16,),
            ("row x column",),
        ),
        Field("source_fps", "float64", "rate of the source file", unit="1 / second"),
        Field("first_source_frame", _WHOLE, "first of source_frames"),
        Field("last_source_frame", _WHOLE, "last of source_frames"),
        Field("source_files", _WHOLE, "rows of files.parquet it was read from", ("file",), ("file",)),
        Field("synthetic", "bool", "whether the raw data was generated"),
        Field(
            "gravity_note", _TEXT, "how gravity was estimated, or why it is not known; empty when the source states it",
        ),
        Field("hands_from", _TEXT, "what the source gave", choices=("parameters", "keypoints")),
        Field(
            "fit_error_m", "float64", "mean error of hands fitted to keypoints; null for parameters", unit="metre",
            required=False,
        ),
        Field("camera_name", _TEXT, "as in the source; null without a camera", required=False),
        Field(
            "camera_intrinsics", "float64", "fx, fy, cx, cy, width, height", (6,), ("value",), "pixel",
            required=False,
        ),
        _rows_of("camera_row", "the camera_ arrays", optional=True),
        _rows_of("body_row", "the arrays of body-*.npz", optional=True),
        _rows_of("expression_row", "expression in body-*.npz", optional=True),
        _rows_of("source_contact_row", "the arrays of source_contact-*.npz", optional=True),
        Field("source_contact_count", _ROW, "how many rows; 0 for a clip without"),
    ),
)  # fmt: skip

OBJECTS = StoreFile(
    "meta/objects.parquet",
    "one row per object",
    "by object",
    (
        Field("object", _TEXT, "unique; <name>#<start of digest> where meshes of one name differ"),
        Field("n_vertices", _WHOLE, "vertices"),
        Field("n_faces", _WHOLE, "triangles"),
        Field("articulated", "bool", "whether it has a hinge"),
        Field("hinge_axis", "float64", "unit vector; null when rigid", (3,), ("xyz",), "", "object", required=False),
        Field(
            "hinge_origin_m", "float64", "a point of the hinge; null when rigid", (3,), ("xyz",), "metre", "object",
            required=False,
        ),
        Field("digest", _TEXT, "SHA-256 of vertices_m, faces, part, hinge_axis and hinge_origin_m, in that order"),
    ),
)  # fmt: skip

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
    "what was left out",
    "as written",
    (
        Field("source_key", _TEXT, "the sequence, or the clip"),
        Field("where", _TEXT, "the file or field"),
        Field("expected", _TEXT, "what had to be there"),
        Field("got", _TEXT, "what was there"),
        Field("remedy", _TEXT, "what to do"),
    ),
)

INFO = StoreFile(
    "meta/info.json",
    "facts of the whole store; a dot means a key inside; further keys are free, conversions add some",
    "keys by name",
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
        Field("frame.up_axis", "string", "null when the source does not say", required=False,
              choices=("+x", "-x", "+y", "-y", "+z", "-z")),
        Field("frame.gravity", "string", "where gravity comes from", choices=("stated", "estimated", "unknown")),
        Field("frame.note", "string", "one sentence for people"),
        Field("hand_model.name", "string", "mano, or embedded"),
        Field("hand_model.digest", "string", "SHA-256 of the hand model the parameters belong to"),
        Field("hand_convention.left_shape", "string", "sign of the left hand's shape directions in the source",
              choices=("as released", "corrected", "unused", "unknown")),
        Field("hand_convention.note", "string", "what the source's hand parameters meant"),
        Field("licence", "string", "of the raw data"),
        Field("may_be_shared", "boolean", "whether the licence lets derived data be passed on"),
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
AXES = {
    field.name.replace("left_", "<side>_"): list(field.axes)
    for field in FRAMES.fields
    if not field.name.startswith("right_")
}

_ARROW = {
    "string": pa.string(), "bool": pa.bool_(), "int32": pa.int32(), "int64": pa.int64(), "float64": pa.float64(),
}  # fmt: skip


def arrow_schema(file: StoreFile) -> pa.Schema:
    """The Parquet schema of a table; fields with an axis are lists."""
    return pa.schema([(f.name, pa.list_(_ARROW[f.dtype]) if f.shape else _ARROW[f.dtype]) for f in file.fields])


def empty_array(field: Field) -> np.ndarray:
    """An array of that field without rows."""
    return np.zeros((0, *field.row_shape), field.dtype)


def value_at(info: Any, name: str) -> Any:
    """The value of a dotted key of info.json. Raises KeyError when it is not there."""
    for key in name.split("."):
        if not isinstance(info, dict) or key not in info:
            raise KeyError(name)
        info = info[key]
    return info
