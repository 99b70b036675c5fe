"""File formats that the three writers share: text, meshes, and object arrays in the format of NumPy 1."""

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

# Real files were pickled by NumPy 1, before numpy.core became numpy._core.
_NEW_SPELLING, _OLD_SPELLING = b"cnumpy._core.", b"cnumpy.core."
_ZIP_TIME = (1980, 1, 1, 0, 0, 0)


def gender(subject: str) -> str:
    """Return the gender of a subject with a number, such as ``s01``."""
    return "male" if int(subject[1:]) % 2 else "female"


def write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="ascii")


def obj_text(vertices: np.ndarray, faces: np.ndarray) -> str:
    """Format vertices (vertex, 3) and triangles as Wavefront OBJ."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return "\n".join(lines) + "\n"


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Binary little-endian PLY, float32 vertices."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corner", "<i4", 3)])
    rows["count"], rows["corner"] = 3, faces
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes())


def npy_bytes(value: Any) -> bytes:
    """Return the bytes of an .npy file. A dict becomes a 0-d object array, as in NumPy 1."""
    stream = io.BytesIO()
    if not isinstance(value, dict):
        np.lib.format.write_array(stream, np.asanyarray(value), allow_pickle=False)
        return stream.getvalue()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
    boxed = np.empty((), dtype=object)
    boxed[()] = value
    pickled = pickle.dumps(boxed, protocol=3)
    return stream.getvalue() + pickled.replace(_NEW_SPELLING, _OLD_SPELLING)


def write_npy(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(npy_bytes(value))


def write_npz(path: Path, members: dict[str, Any]) -> None:
    """Write an .npz of 0-d members; equal members give equal bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, value in members.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _ZIP_TIME), npy_bytes(value), zipfile.ZIP_DEFLATED, 1)
