"""Mesh files of a raw tree, parsed once per content: hundreds of sequences hold the same few objects."""

from collections import OrderedDict
from pathlib import PurePosixPath

from hoidata.datasets.base import RawTree
from hoidata.objects.mesh import Mesh, load_mesh

MOST_BYTES = 256 << 20  # of the arrays kept by one process: the 51 objects of GRAB take 180 MB

_known: OrderedDict[tuple[str, str], Mesh] = OrderedDict()


def raw_mesh(raw: RawTree, path: str) -> Mesh:
    """The mesh file at ``path``, recorded and checked as ``raw.file`` does, and read as ``load_mesh`` does.

    Arrays are the caller's own. What was parsed is known again by its SHA-256 and the ending of its name; the meshes
    used longest ago are forgotten when all take more than ``MOST_BYTES``.
    """
    place = raw.file(path)
    (source,) = raw.recorded(path)
    key = source.sha256, PurePosixPath(path).suffix.lower()
    if key not in _known:
        _known[key] = load_mesh(place)
        while len(_known) > 1 and sum(array.nbytes for known in _known.values() for array in known) > MOST_BYTES:
            _known.popitem(last=False)
    _known.move_to_end(key)
    mesh = _known[key]
    return Mesh(mesh.vertices.copy(), mesh.faces.copy())
