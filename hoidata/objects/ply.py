"""Strict reader of PLY meshes (Turk, "The PLY Polygon File Format", 1994), text and binary.

Only vertex positions and face corners are kept; colours, normals and textures are passed over. No count that a header
states is allocated before the file is known to be long enough for it.
"""

from collections.abc import Iterator
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
_MOST_WORDS = 16_000_000
_BLOCK = 1 << 20  # numbers, or bytes, that are looked at together


class _Property(NamedTuple):
    """kind: NumPy's name of the type; count_kind: of a list's length, None for a single number."""

    name: str
    kind: str
    count_kind: str | None


class _Element(NamedTuple):
    name: str
    count: int
    properties: list[_Property]


def parse_ply(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (vertex, 3) float64 and triangles (face, 3) int64; polygons become fans.

    Vertices are as stored and in order. Raises ValueError when it is no PLY file, ends early or lacks either.
    """
    order, elements, start = _read_header(data)
    rows = _BinaryRows(data, start, order) if order else _TextRows(data[start:])
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    stated = {element.name: element.count for element in elements}
    triangles = 0
    _check_counts(stated.get("vertex", 0), stated.get("face", 0))
    for element in elements[: _last_needed(elements) + 1]:
        for columns in _read_rows(rows, element):
            if element.name == "vertex":
                vertices.append(_positions(element, columns))
            elif element.name == "face":
                faces.append(_fans(element, columns))
                triangles += len(faces[-1])
                _check_counts(0, triangles)
    return np.concatenate([np.zeros((0, 3)), *vertices]), np.concatenate([np.zeros((0, 3), np.int64), *faces])


def _check_counts(vertices: int, triangles: int) -> None:
    """Raise ValueError for more than a mesh may have; each takes some hundred bytes while it is read."""
    if vertices > MOST_VERTICES or triangles > MOST_TRIANGLES:
        raise ValueError(f"more than {MOST_VERTICES} vertices or {MOST_TRIANGLES} triangles: decimate the mesh")


def _read_header(data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ("" for text), elements, and where the rows start."""
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


def _last_needed(elements: list[_Element]) -> int:
    """Number of the element with which vertices and faces are both read."""
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError("no vertices")
    if len(set(names)) != len(names):
        raise ValueError("an element declared twice")
    return max(names.index("vertex"), names.index("face") if "face" in names else 0)


def _read_rows(rows: "_BinaryRows | _TextRows", element: _Element) -> Iterator[list[np.ndarray]]:
    """The rows of an element in blocks of equal list lengths, (row, number) for each property."""
    left = chunk = element.count
    while left and element.properties:
        lengths = rows.lengths(element)
        block = rows.block(element, lengths, min(chunk, left))
        same = np.ones(len(block[0][1]), dtype=bool)
        for (stated, _), length in zip(block, lengths, strict=True):
            if stated is not None:
                same &= stated == length
        taken = len(same) if same.all() else int(same.argmin())
        yield [values[:taken] for _, values in block]
        rows.advance(taken)
        left -= taken
        # After a block of mixed lengths try about as many as fitted: reading all that is left again would be quadratic.
        chunk = 2 * taken


class _BinaryRows:
    """The rows of a file, in order."""

    def __init__(self, data: bytes, start: int, order: str) -> None:
        self.data, self.offset, self.order = data, start, order
        self.row_bytes = 0

    def lengths(self, element: _Element) -> list[int]:
        """How many numbers each property of the next row has."""
        offset, found = self.offset, []
        for item in element.properties:
            length = 1
            if item.count_kind is not None:
                kind = np.dtype(self.order + item.count_kind)
                if offset + kind.itemsize > len(self.data):
                    raise ValueError(f"the file ends within its element {element.name[:40]!r}")
                length = _checked_length(np.frombuffer(self.data, kind, 1, offset)[0])
                offset += kind.itemsize
            offset += length * np.dtype(item.kind).itemsize
            found.append(length)
        if offset > len(self.data):
            raise ValueError(f"the file ends within its element {element.name[:40]!r}")
        return found

    def block(self, element: _Element, lengths: list[int], most: int) -> list[tuple[np.ndarray | None, np.ndarray]]:
        """Up to ``most`` rows, read as if each had these lengths: per property the stated lengths and (row, number)."""
        fields = []
        for number, (item, length) in enumerate(zip(element.properties, lengths, strict=True)):
            if item.count_kind is not None:
                fields.append((f"length{number}", self.order + item.count_kind))
            fields.append((f"values{number}", self.order + item.kind, (length,)))
        kind = np.dtype(fields)
        self.row_bytes = kind.itemsize
        here = (len(self.data) - self.offset) // max(1, kind.itemsize)
        fitting = min(most, here, 1 + _BLOCK // max(1, kind.itemsize))
        table = np.frombuffer(self.data, kind, fitting, self.offset)
        found = []
        for number, item in enumerate(element.properties):
            stated = None if item.count_kind is None else table[f"length{number}"]
            found.append((stated, table[f"values{number}"]))
        return found

    def advance(self, rows: int) -> None:
        self.offset += rows * self.row_bytes


class _TextRows:
    """As ``_BinaryRows``, of a text file."""

    def __init__(self, text: bytes) -> None:
        # Counted first: a word takes fifty bytes.
        if sum(map(text.count, (b" ", b"\n", b"\t", b"\r"))) > _MOST_WORDS:
            raise ValueError(f"more than {_MOST_WORDS} words: decimate the mesh, or write it in binary")
        self.words = text.split()
        self.offset = self.width = 0
        if max(map(len, self.words), default=0) > _LONGEST_WORD:
            raise ValueError(f"a word of more than {_LONGEST_WORD} characters among its numbers")

    def lengths(self, element: _Element) -> list[int]:
        offset, found = self.offset, []
        for item in element.properties:
            length = 1
            if item.count_kind is not None:
                if offset >= len(self.words):
                    raise ValueError(f"the file ends within its element {element.name[:40]!r}")
                length = _checked_length(float(self.words[offset]))
                offset += 1
            offset += length
            found.append(length)
        if offset > len(self.words):
            raise ValueError(f"the file ends within its element {element.name[:40]!r}")
        return found

    def block(self, element: _Element, lengths: list[int], most: int) -> list[tuple[np.ndarray | None, np.ndarray]]:
        self.width = sum(lengths) + sum(item.count_kind is not None for item in element.properties)
        here = (len(self.words) - self.offset) // self.width
        fitting = min(most, here, 1 + _BLOCK // self.width)
        words = np.array(self.words[self.offset : self.offset + fitting * self.width])
        with np.errstate(all="ignore"):  # what does not fit its type becomes infinite, and is refused as such
            return self._columns(element, lengths, words.astype(np.float64).reshape(fitting, self.width))

    def _columns(
        self, element: _Element, lengths: list[int], table: np.ndarray
    ) -> list[tuple[np.ndarray | None, np.ndarray]]:
        found, column = [], 0
        for item, length in zip(element.properties, lengths, strict=True):
            stated = None if item.count_kind is None else table[:, column]
            column += stated is not None
            values = table[:, column : column + length].astype(item.kind if item.kind[0] == "f" else np.float64)
            found.append((stated, values))
            column += length
        return found

    def advance(self, rows: int) -> None:
        self.offset += rows * self.width


def _checked_length(value: float) -> int:
    if not 0 <= value <= MOST_CORNERS or value != int(value):
        raise ValueError(f"a list of {value} numbers; at most {MOST_CORNERS}")
    return int(value)


def _positions(element: _Element, columns: list[np.ndarray]) -> np.ndarray:
    names = [item.name for item in element.properties]
    numbers = [names.index(axis) for axis in "xyz" if axis in names]
    if len(numbers) < 3 or any(element.properties[number].count_kind is not None for number in numbers):
        raise ValueError("vertices without x, y and z")
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one, and is refused as such
        return np.concatenate([columns[number] for number in numbers], axis=1).astype(np.float64)


def _fans(element: _Element, columns: list[np.ndarray]) -> np.ndarray:
    """Triangles (0, 1, 2), (0, 2, 3) and so on of each polygon."""
    numbers = [number for number, item in enumerate(element.properties) if item.name in _CORNERS and item.count_kind]
    if not numbers:
        raise ValueError("faces without vertex_indices")
    corners = columns[numbers[0]]
    if len(corners) and corners.shape[1] < 3:
        raise ValueError(f"a face of {corners.shape[1]} corners")
    with np.errstate(invalid="ignore"):
        whole = np.asarray(corners, dtype=np.float64)
    if not (np.isfinite(whole).all() and (whole == np.rint(whole)).all() and (np.abs(whole) < 2**53).all()):
        raise ValueError("a corner that is no whole number")
    first, second, third = whole[:, :1], whole[:, 1:-1], whole[:, 2:]
    fans = np.stack((np.broadcast_to(first, second.shape), second, third), axis=-1)
    return fans.reshape(-1, 3).astype(np.int64)
