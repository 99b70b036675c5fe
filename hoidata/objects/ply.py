"""Strict reader of PLY meshes (Turk, "The PLY Polygon File Format", 1994), text and binary.

Only vertex positions and face corners are kept; colours, normals and textures are skipped. The reader allocates
nothing for a stated count until the file is known to be long enough. trimesh has no reader of mixed polygons in binary
files, and shortens truncated text without an error.
"""

import contextlib
import struct
from array import array
from typing import NamedTuple

import numpy as np

_LONGEST_HEADER = 1 << 16
_LONGEST_WORD = 64
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_CORNERS = ("vertex_indices", "vertex_index")
MOST_VERTICES, MOST_TRIANGLES = 1_000_000, 3_000_000
MOST_CORNERS = 10_000  # of one polygon: the lid of a finely cut cylinder may have thousands
_MAX_WORDS = 16_000_000
_STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}


class _Property(NamedTuple):
    """A property of an element, as the header declares it."""

    name: str
    kind: str  # NumPy's name of the type
    count_kind: str | None  # the type of a list's length; None for a single number


class _Element(NamedTuple):
    name: str
    count: int
    properties: list[_Property]


class _Column(NamedTuple):
    """The values of one property in all rows of an element."""

    lengths: np.ndarray  # (row,) numbers in each row
    values: np.ndarray  # (number,) of all rows


def parse_ply(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Parse a PLY file; polygons become fans.

    Returns vertices (vertex, 3) float64 in the stored order, and triangles (face, 3) int64. Raises ValueError: the file
    is not a PLY file, is truncated, or has no vertices.
    """
    order, elements, start = _read_header(data)
    stated = {element.name: element.count for element in elements}
    _check_counts(stated.get("vertex", 0), stated.get("face", 0))
    as_stored = elements
    if not order:
        data, start, order = _numbers(data[start:]), 0, "<"
        as_stored = [_as_numbers(element) for element in elements]
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    last_required = _last_required(elements)
    for number, (element, stored) in enumerate(zip(elements, as_stored, strict=True)):
        if number > last_required:
            break
        if element.name == "vertex":
            columns, start = _read_rows(data, start, order, stored, _axes(element))
            vertices = _positions(element, columns)
        elif element.name == "face":
            columns, start = _read_rows(data, start, order, stored, [_corner_list(element)])
            faces = _fans(*columns)
        else:
            _, start = _read_rows(data, start, order, stored, [])
    return vertices, faces


def _check_counts(vertices: int, triangles: int) -> None:
    """Raise ValueError for more than a mesh may have; each vertex or triangle takes some hundred bytes of memory."""
    if vertices > MOST_VERTICES or triangles > MOST_TRIANGLES:
        raise ValueError(f"more than {MOST_VERTICES} vertices or {MOST_TRIANGLES} triangles: decimate the mesh")


def _read_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ("" for text), elements, and offset of the first row."""
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    stop = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or not stop:
        raise ValueError("no header from 'ply' to 'end_header'")
    lines = [line.split() for line in data[:end].decode("latin1").splitlines()[1:] if line.strip()]
    elements: list[_Element] = []
    order = None
    for words in lines:
        match words:
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 12:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= set(_KINDS):
                elements[-1].properties.append(_Property(name, _KINDS[kind], _KINDS[count]))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1].properties.append(_Property(name, _KINDS[kind], None))
            case _:
                raise ValueError(f"the header line {' '.join(words)[:60]!r}")
    if order is None:
        raise ValueError("a header without a known format")
    return order, elements, stop


def _last_required(elements: list[_Element]) -> int:
    """Index of the last element that must be read to have vertices and faces."""
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError("no vertices")
    if len(set(names)) != len(names):
        raise ValueError("an element declared twice")
    return max(names.index("vertex"), names.index("face") if "face" in names else 0)


def _numbers(text: bytes) -> bytes:
    """The numbers of a text file as float64 bytes, up to the first word that is not a number."""
    # Count before splitting, because a word takes fifty bytes.
    if sum(map(text.count, (b" ", b"\n", b"\t", b"\r"))) > _MAX_WORDS:
        raise ValueError(f"more than {_MAX_WORDS} words: decimate the mesh, or write it in binary")
    words = text.split()
    if max(map(len, words), default=0) > _LONGEST_WORD:
        raise ValueError(f"a word of more than {_LONGEST_WORD} characters among its numbers")
    numbers = array("d")
    with contextlib.suppress(ValueError):  # anything may follow the last required element
        numbers.extend(map(float, words))
    return numbers.tobytes()


def _as_numbers(element: _Element) -> _Element:
    """The element of a text file after its words are converted to float64."""
    properties = [_Property(item.name, "f8", item.count_kind and "f8") for item in element.properties]
    return _Element(element.name, element.count, properties)


def _read_rows(
    data: bytes, start: int, order: str, element: _Element, properties: list[int]
) -> tuple[list[_Column], int]:
    """Read some properties of an element, by index. Returns their columns and the offset of the next element."""
    has_lists = any(item.count_kind for item in element.properties)
    if has_lists and element.count > MOST_TRIANGLES:
        raise ValueError(f"more than {MOST_TRIANGLES} lists: decimate the mesh")
    equal = _equal_rows(data, start, order, element, properties)
    if equal is not None:
        return equal
    if not has_lists:
        raise ValueError(f"the file ends within its element {element.name[:40]!r}")
    return _each_row(data, start, order, element, properties, element.count)


def _each_row(
    data: bytes, start: int, order: str, element: _Element, properties: list[int], count: int
) -> tuple[list[_Column], int]:
    """The result of ``_read_rows`` for the first ``count`` rows, read one after the other."""
    readers = [
        (
            struct.Struct(order + _STRUCT_CODES[item.count_kind]) if item.count_kind else None,
            _STRUCT_CODES[item.kind],
            np.dtype(item.kind).itemsize,
        )
        for item in element.properties
    ]
    lengths, values = {number: array("q") for number in properties}, {number: array("d") for number in properties}
    offset = start
    try:
        for _ in range(count):
            for number, (counter, code, size) in enumerate(readers):
                length = 1
                if counter is not None:
                    length = _checked_length(counter.unpack_from(data, offset)[0])
                    offset += counter.size
                if number in lengths:
                    lengths[number].append(length)
                    values[number].extend(struct.unpack_from(f"{order}{length}{code}", data, offset))
                    if len(values[number]) > 3 * MOST_TRIANGLES:
                        raise ValueError(f"more than {MOST_TRIANGLES} triangles: decimate the mesh")
                offset += length * size
    except struct.error:
        offset = len(data) + 1
    if offset > len(data):
        raise ValueError(f"the file ends within its element {element.name[:40]!r}")
    return [_Column(np.array(lengths[number], np.int64), np.array(values[number])) for number in properties], offset


def _equal_rows(
    data: bytes, start: int, order: str, element: _Element, properties: list[int]
) -> tuple[list[_Column], int] | None:
    """The result of ``_read_rows`` if all rows are as long as the first, else None. Fast for triangle meshes."""
    everything = list(range(len(element.properties)))
    first = _each_row(data, start, order, element, everything, 1)[0] if element.count else []
    lengths = [len(column.values) for column in first] or [1] * len(everything)
    fields: list[tuple] = []
    for number, (item, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if item.count_kind is not None:
            fields.append((f"length{number}", order + item.count_kind))
        fields.append((f"values{number}", order + item.kind, (length,)))
    kind = np.dtype(fields)
    end = start + element.count * kind.itemsize
    if end > len(data):
        return None
    table = np.frombuffer(data, kind, element.count if kind.itemsize else 0, start)
    for number, length in enumerate(lengths):
        if element.properties[number].count_kind is not None and (table[f"length{number}"] != length).any():
            return None
    return [
        _Column(np.full(element.count, lengths[number]), table[f"values{number}"].reshape(-1)) for number in properties
    ], end


def _checked_length(value: float) -> int:
    if not 0 <= value <= MOST_CORNERS or value != int(value):
        raise ValueError(f"a list of {value} numbers; at most {MOST_CORNERS}")
    return int(value)


def _axes(element: _Element) -> list[int]:
    """Indices of the properties x, y and z."""
    names = [item.name for item in element.properties]
    numbers = [names.index(axis) for axis in "xyz" if axis in names]
    if len(numbers) < 3 or any(element.properties[number].count_kind is not None for number in numbers):
        raise ValueError("vertices without x, y and z")
    return numbers


def _positions(element: _Element, columns: list[_Column]) -> np.ndarray:
    """(vertex, 3) from the columns x, y and z; numbers in text are rounded to their declared type."""
    kinds = [element.properties[number].kind for number in _axes(element)]
    with np.errstate(all="ignore"):  # NaN and overflow to infinity are refused later
        exact = [
            column.values.astype(kind) if kind[0] == "f" else column.values
            for kind, column in zip(kinds, columns, strict=True)
        ]
        return np.stack([values.astype(np.float64) for values in exact], axis=1)


def _corner_list(element: _Element) -> int:
    """Index of the property that lists a face's corners."""
    for number, item in enumerate(element.properties):
        if item.name in _CORNERS and item.count_kind:
            return number
    raise ValueError("faces without vertex_indices")


def _fans(lists: _Column) -> np.ndarray:
    """Triangles (0, 1, 2), (0, 2, 3) and so on of each polygon."""
    lengths = lists.lengths
    if lengths.min(initial=3) < 3:
        raise ValueError(f"a face of {lengths.min()} corners")
    triangles = lengths - 2
    _check_counts(0, int(triangles.sum()))
    with np.errstate(invalid="ignore"):
        corner_numbers = lists.values.astype(np.float64)
    if not (
        np.isfinite(corner_numbers).all()
        and (corner_numbers == np.rint(corner_numbers)).all()
        and (np.abs(corner_numbers) < 2**53).all()
    ):
        raise ValueError("a corner that is no whole number")
    corners = corner_numbers.astype(np.int64)
    first = (np.cumsum(lengths) - lengths).repeat(triangles)
    second = first + 1 + np.arange(triangles.sum()) - (np.cumsum(triangles) - triangles).repeat(triangles)
    return np.stack((corners[first], corners[second], corners[second + 1]), axis=1)
