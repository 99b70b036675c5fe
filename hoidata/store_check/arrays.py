"""Checks the array files of a store against the schema and against the table rows that refer to them."""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES
from hoidata.clips.validation import frame_numbers_rise
from hoidata.errors import BadInput
from hoidata.objects.model import ObjectModel
from hoidata.store.fields import (
    BODY,
    FRAMES,
    INFO,
    OBJECT_ARRAYS,
    OBJECTS,
    RECORDINGS,
    SEQUENCES,
    SOURCE_CONTACT,
    SOURCE_HANDS,
    TEMPLATES,
    Field,
    StoreFile,
)
from hoidata.store.mapped import map_npz
from hoidata.store.store import stored_hinge
from hoidata.store.writing import mesh_digest, template_key
from hoidata.store_check.tables import REMEDY, Columns

Arrays = dict[str, np.ndarray]
_STEP = 1 << 20  # rows that are checked for NaN in one call


class _Range(NamedTuple):
    """Which rows of an array member belong to a clip."""

    file: StoreFile
    member: str
    column: str  # column of ``sequences`` with the first row, -1 for a clip without rows
    count: Callable[[dict[str, Any]], int]  # number of rows, from the clip's row of ``sequences``


_RANGES = (
    _Range(FRAMES, "source_frames", "first_row", itemgetter("n_frames")),
    _Range(FRAMES, "left_betas", "left_betas_row", itemgetter("left_betas_count")),
    _Range(FRAMES, "right_betas", "right_betas_row", itemgetter("right_betas_count")),
    _Range(FRAMES, "other_rotvec", "other_row", lambda row: row["n_frames"] * len(row["other_objects"])),
    _Range(FRAMES, "camera_rotvec", "camera_row", itemgetter("n_frames")),
    _Range(BODY, "transl_m", "body_row", itemgetter("n_frames")),
    _Range(BODY, "expression", "expression_row", itemgetter("n_frames")),
    _Range(SOURCE_CONTACT, "frame", "source_contact_row", itemgetter("source_contact_count")),
)


def read_shards(folder: Path, file: StoreFile, paths: Iterable[str]) -> tuple[dict[int, Arrays], list[BadInput]]:
    """Read the shards of one kind. Returns the valid shards by number, and the problems of the others.

    paths: paths of all files of the store.
    """
    start, end = file.path.split("*")
    shards, problems = {}, []
    for path in sorted(path for path in paths if path.startswith(start)):
        arrays, member_problems = read_members(folder, path, {field.name: field for field in file.fields})
        problems += member_problems
        if arrays is not None:
            length_problems = list(_equal_lengths(path, file.fields, arrays))
            problems += length_problems
            if not length_problems:
                shards[int(path.removeprefix(start).removesuffix(end))] = arrays
    return shards, problems


def read_members(folder: Path, path: str, fields: dict[str, Field]) -> tuple[Arrays | None, list[BadInput]]:
    """Read the members ``fields`` of an array file. Returns None for the arrays if one is invalid."""
    if not (folder / path).is_file():
        return None, []  # reported with the missing files
    try:
        arrays = map_npz(folder / path)
    except BadInput as error:
        return None, [BadInput(error.where.removeprefix(f"{folder}/"), error.expected, error.got, REMEDY)]
    absent = [f"{path}: {name}" for name in fields if name not in arrays]
    problems = [BadInput(member, "a member", "nothing there", REMEDY) for member in absent]
    for name, array in arrays.items():
        if name not in fields:
            problems.append(BadInput(f"{path}: {name}", "only the members of the schema", "a further one", REMEDY))
            continue
        problems += _member_problems(f"{path}: {name}", fields[name], array)
    return (None if problems else arrays), problems


def _member_problems(member: str, field: Field, array: np.ndarray) -> Iterator[BadInput]:
    lengths = (*array.shape, *[0] * (len(field.shape) - array.ndim))
    shape = tuple(n if isinstance(n, int) else m for n, m in zip(field.shape, lengths, strict=False))
    if array.dtype != np.dtype(field.dtype):
        yield BadInput(member, field.dtype, f"{array.dtype}", REMEDY)
    elif array.shape != shape:
        text = " x ".join(str(length) for length in field.shape)
        yield BadInput(member, f"shape {text}", f"{array.shape}", REMEDY)
    elif array.dtype.kind == "f":
        wrong = sum(int((~np.isfinite(array[at : at + _STEP])).sum()) for at in range(0, len(array), _STEP))
        if wrong:
            yield BadInput(member, "finite numbers", f"{wrong} that are NaN or infinite", REMEDY)
    elif array.dtype == bool and array.view(np.uint8).max(initial=0) > 1:
        yield BadInput(member, "bytes 0 and 1", f"{array.view(np.uint8).max()}", REMEDY)


def _equal_lengths(path: str, fields: Iterable[Field], arrays: Arrays) -> Iterator[BadInput]:
    """Check that members with the same first axis have equally many rows."""
    lengths: dict[Any, tuple[str, int]] = {}
    for field in fields:
        name, length = lengths.setdefault(field.shape[0], (field.name, len(arrays[field.name])))
        if length != len(arrays[field.name]):
            expected = f"{length} rows as in {name}"
            yield BadInput(f"{path}: {field.name}", expected, f"{len(arrays[field.name])}", REMEDY)


def shard_problems(file: StoreFile, shards: dict[int, Arrays], sequences: Columns) -> Iterator[BadInput]:
    """Check that the clips cover each shard exactly, and that their table rows agree with the arrays."""
    for number, arrays in shards.items():
        clips = [clip for clip in _rows(sequences) if clip["shard"] == number]
        kinds = [kind for kind in _RANGES if kind.file is file]
        by_kind = [list(_range_problems(kind, number, clips, len(arrays[kind.member]))) for kind in kinds]
        range_problems = list(chain.from_iterable(by_kind))
        yield from range_problems
        if file is FRAMES and not range_problems:
            yield from _frame_problems(clips, arrays)


def _range_problems(kind: _Range, number: int, clips: list[dict[str, Any]], length: int) -> Iterator[BadInput]:
    """Check that the clips of a shard fill it one after another, in their order."""
    start, path = 0, kind.file.path.replace("*", f"{number:05d}")
    for clip in clips:
        if clip[kind.column] == -1:
            continue
        if clip[kind.column] != start:
            column = f"{SEQUENCES.path}: {kind.column} of {clip['clip_id']}"
            yield BadInput(column, f"{start}, where the clip before it ends in {path}", f"{clip[kind.column]}", REMEDY)
            return
        start += kind.count(clip)
    if start != length:
        yield BadInput(f"{path}: {kind.member}", f"{start} rows for the clips of {SEQUENCES.path}", f"{length}", REMEDY)


def _frame_problems(clips: list[dict[str, Any]], arrays: Arrays) -> Iterator[BadInput]:
    for clip in clips:
        frames = slice(clip["first_row"], clip["first_row"] + clip["n_frames"])
        source = arrays["source_frames"][frames]
        if not frame_numbers_rise(source, clip["source_fps"]):
            yield BadInput(f"{FRAMES.path}: source_frames of {clip['clip_id']}", "rising numbers", "others", REMEDY)
        from_arrays = {
            "first_source_frame": int(source[0]),
            "last_source_frame": int(source[-1]),
            **{f"{side}_valid_frames": int(arrays[f"{side}_valid"][frames].sum()) for side in SIDES},
        }
        for name, value in from_arrays.items():
            if clip[name] != value:
                column = f"{SEQUENCES.path}: {name} of {clip['clip_id']}"
                yield BadInput(column, f"{value} as in its shard", f"{clip[name]}", REMEDY)
        if not clip["articulated"] and arrays["object_hinge_rad"][frames].any():
            member = f"{FRAMES.path}: object_hinge_rad of {clip['clip_id']}"
            yield BadInput(member, "0 for a rigid object", "other angles", REMEDY)


def mesh_problems(folder: Path, objects: Columns) -> Iterator[BadInput]:
    """Check objects.npz against the rows of the objects table."""
    fields = {f"{name}/{field.name}": field for name in objects["object"] for field in OBJECT_ARRAYS.fields}
    arrays, problems = read_members(folder, OBJECT_ARRAYS.path, fields)
    yield from problems
    if arrays is not None:
        for facts in _rows(objects):
            yield from _mesh_problems(facts, arrays)


def template_problems(folder: Path, sequences: Columns) -> Iterator[BadInput]:
    """Check templates.npz against the rows of the sequences table."""
    names = {name for side in SIDES for name in sequences[f"{side}_template"] if name is not None}
    arrays, problems = read_members(folder, TEMPLATES.path, {name: TEMPLATES.fields[0] for name in sorted(names)})
    yield from problems
    for name, template_m in (arrays or {}).items():
        if template_key(template_m) != name:
            expected = "a name that is the start of its SHA-256"
            yield BadInput(f"{TEMPLATES.path}: {name}", expected, template_key(template_m), REMEDY)


def _rows(columns: Columns) -> list[dict[str, Any]]:
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _mesh_problems(facts: dict[str, Any], arrays: Arrays) -> Iterator[BadInput]:
    name = facts["object"]
    mesh = {field.name: np.array(arrays[f"{name}/{field.name}"]) for field in OBJECT_ARRAYS.fields}
    path = f"{OBJECT_ARRAYS.path}: {name}"
    for column, member in (("n_vertices", "vertices_m"), ("n_faces", "faces"), ("n_vertices", "part")):
        if facts[column] != len(mesh[member]):
            expected = f"{facts[column]} rows as in {OBJECTS.path}"
            yield BadInput(f"{path}/{member}", expected, f"{len(mesh[member])}", REMEDY)
    faces = mesh["faces"]
    if not faces.size or faces.min() < 0 or faces.max() >= len(mesh["vertices_m"]):
        expected = f"triangles of vertices 0 to {len(mesh['vertices_m']) - 1}"
        yield BadInput(f"{path}/faces", expected, "none" if not faces.size else "other numbers", REMEDY)
    if mesh["part"].max(initial=0) > 1:
        yield BadInput(f"{path}/part", "0 and 1", f"{mesh['part'].max()}", REMEDY)
    axis = facts["hinge_axis"]
    hinge = None if axis is None else stored_hinge(axis, facts["hinge_origin_m"])
    digest = mesh_digest(mesh, ObjectModel(name, hinge=hinge, **mesh))
    if digest != facts["digest"]:
        yield BadInput(f"{OBJECTS.path}: digest of {name}", f"{digest} as its mesh says", f"{facts['digest']}", REMEDY)


_RECORDING_FACTS = ("subject", "fps", "frames", "object", "hand", "gravity", "source_files")


def recording_problems(folder: Path, info: dict[str, Any], objects: set[str], n_files: int) -> Iterator[BadInput]:
    """Check the whole recordings, if the store has any. objects: keys of meshes; n_files: rows of the files table."""
    recordings, hands = info.get("recordings", {}), info.get("source_hands", {})
    if not isinstance(recordings, dict) or not isinstance(hands, dict):
        yield BadInput(f"{INFO.path}: recordings", "facts by sequence, and of hands", "something else", REMEDY)
        return
    is_valid = True
    for name, facts in recordings.items():
        for problem in _recording_facts(f"{INFO.path}: recordings.{name}", facts, objects, set(hands), n_files):
            is_valid = False
            yield problem
    if recordings and is_valid:
        yield from _recorded_arrays(folder, recordings, hands)


def _recording_facts(source: str, facts: Any, objects: set[str], hands: set[str], n_files: int) -> Iterator[BadInput]:
    if not isinstance(facts, dict) or set(_RECORDING_FACTS) - set(facts):
        yield BadInput(source, f"an object with {', '.join(_RECORDING_FACTS)}", repr(facts)[:80], REMEDY)
        return
    for key, valid_keys in (("object", objects), ("hand", hands)):
        if facts[key] not in valid_keys:
            yield BadInput(f"{source}.{key}", "a key in the store", f"{facts[key]}", REMEDY)
    if not all(isinstance(number, int) and 0 <= number < n_files for number in facts["source_files"]):
        yield BadInput(f"{source}.source_files", f"rows 0 to {n_files - 1}", f"{facts['source_files']}", REMEDY)


def _recorded_arrays(folder: Path, recordings: dict[str, Any], hands: dict[str, Any]) -> Iterator[BadInput]:
    for file, names in ((RECORDINGS, recordings), (SOURCE_HANDS, hands)):
        members = {f"{name}/{field.name}": field for name in names for field in file.fields}
        arrays, problems = read_members(folder, file.path, members)
        yield from problems
        if arrays is None:
            return
        counts = {name: len(facts["joints"]) for name, facts in hands.items()}
        for member, field in members.items():
            name = member.removesuffix(f"/{field.name}")
            lengths: dict[int | str, int] = {"frame": recordings[name]["frames"]} if file is RECORDINGS else {}
            lengths["joint"] = counts[recordings[name]["hand"] if file is RECORDINGS else name]
            expected = tuple(lengths.get(axis, axis) for axis in field.shape)
            shape = arrays[member].shape
            if any(isinstance(n, int) and n != m for n, m in zip(expected, shape, strict=True)):
                yield BadInput(f"{file.path}: {member}", f"shape {expected}", f"{shape}", REMEDY)
