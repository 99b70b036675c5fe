"""Reader of STL meshes, binary and text (3D Systems, "StereoLithography Interface Specification", 1989).

Each triangle has three separate corners, in the stored order. Stored normals and attributes are ignored. Some programs
start binary files with "solid" as well, so the length decides. trimesh drops a truncated solid without an error, and
takes quadratic time for solids with equal names.
"""

import io
from array import array
from typing import NamedTuple

import numpy as np

_HEADER_BYTES, _ROW_BYTES = 84, 50
_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_MAX_WORDS = 5  # of a line that counts: "facet normal x y z"


class Stl(NamedTuple):
    """The triangles of an STL file."""

    corners: np.ndarray  # (3 * triangle, 3) float64
    solid: np.ndarray  # (triangle,) index of the solid
    names: list[str]  # of the solids


def parse_stl(data: bytes) -> Stl:
    """Parse the triangles of an STL file. Raises ValueError if it is not an STL file or is truncated."""
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    expected = _HEADER_BYTES + _ROW_BYTES * count
    if len(data) >= _HEADER_BYTES and len(data) == expected:
        return _binary(data, count)
    if data.lstrip()[:5].lower() == b"solid":
        return _text(data)
    if len(data) < max(expected, _HEADER_BYTES):
        raise ValueError(f"{len(data)} bytes for {count} triangles, expected {expected}")
    return _binary(data, count)


def _binary(data: bytes, count: int) -> Stl:
    rows = np.frombuffer(data, _ROW, count, _HEADER_BYTES)
    return Stl(rows["corners"].reshape(-1, 3).astype(np.float64), np.zeros(count, np.int64), [""])


def _text(data: bytes) -> Stl:
    names = [""]
    numbers, solids, corners = array("d"), array("q"), 0
    for line in io.BytesIO(data):
        words = line.split(maxsplit=_MAX_WORDS)
        match words[0].lower() if words else b"":
            case b"vertex" if len(words) >= 4:
                numbers.extend((float(words[1]), float(words[2]), float(words[3])))
                corners += 1
            case b"endfacet":
                if corners != 3:
                    raise ValueError(f"a triangle of {corners} corners")
                solids.append(len(names) - 1)
                corners = 0
            case b"solid":
                if len(names) - 1 in solids[-1:]:  # ignore a solid without triangles
                    names.append("")
                names[-1] = line.strip()[5:65].decode(errors="replace").strip()
            case _:
                pass
    if corners or not data.rstrip().rpartition(b"\n")[2].lstrip().lower().startswith(b"endsolid"):
        raise ValueError("text that ends within a solid")
    return Stl(np.array(numbers).reshape(-1, 3), np.array(solids, dtype=np.int64), names)
