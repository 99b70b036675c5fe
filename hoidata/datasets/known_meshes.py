"""Cache of parsed mesh files by content: hundreds of sequences share a few objects."""

from collections import OrderedDict
from pathlib import PurePosixPath

from hoidata.datasets.base import RawTree
from hoidata.objects.mesh import Mesh, load_mesh

MAX_CACHE_BYTES = 256 << 20  # of arrays per process: the 51 objects of GRAB take 180 MB

_cache: OrderedDict[tuple[str, str], Mesh] = OrderedDict()


def raw_mesh(raw: RawTree, path: str) -> Mesh:
    """Read a mesh with ``load_mesh`` through ``raw``, from the cache if its bytes are known; the caller may change it.

    The cache key is SHA-256 and file extension. Above ``MAX_CACHE_BYTES`` the least recently used meshes are dropped.
    """
    file = raw.file(path)
    (source,) = raw.recorded(path)
    key = source.sha256, PurePosixPath(path).suffix.lower()
    if key not in _cache:
        _cache[key] = load_mesh(file)
        while len(_cache) > 1 and sum(array.nbytes for mesh in _cache.values() for array in mesh) > MAX_CACHE_BYTES:
            _cache.popitem(last=False)
    _cache.move_to_end(key)
    mesh = _cache[key]
    return Mesh(mesh.vertices.copy(), mesh.faces.copy())
