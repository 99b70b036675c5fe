"""Stores in an object store or on another machine: sent and fetched whole, by any address fsspec knows.

Reading maps arrays into memory, so a store is read where it lies on a disk: fetch it, then open it. Every file is held
against its digest on arrival; ``meta/info.json``, without which a folder is no store, is sent last and fetched last.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput, MissingResource
from hoidata.files.atomic import atomic_folder
from hoidata.files.digest import canonical_json, sha256_file
from hoidata.files.written import read_json
from hoidata.store.fields import INFO
from hoidata.store.store import read_info

LISTING = "digests.json"  # beside the files at the address, never in a store
_FLAT = {"s3", "gs", "az", "memory"}  # have no folders; asked for one, they would make a bucket
REMEDY = "send it again, or check the address and the rights"


def push_store(folder: str | Path, address: str) -> int:
    """Send the store ``folder`` to ``address`` (s3://bucket/path, gs://..., /a/path); the number of bytes.

    What is there already with the same bytes is sent anew: listings of object stores do not tell. Raises BadInput
    where something may not be written.
    """
    folder = Path(folder)
    read_info(folder)
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    with _reached(address) as (system, root):
        # Whoever reads meanwhile finds no store rather than half of one.
        for name in (INFO.path, LISTING):
            if system.exists(f"{root}/{name}"):
                system.rm_file(f"{root}/{name}")
        for name in sorted(names, key=lambda name: name == INFO.path):
            if not _FLAT & {*([system.protocol] if isinstance(system.protocol, str) else system.protocol)}:
                system.makedirs(f"{root}/{name}".rpartition("/")[0], exist_ok=True)
            system.put_file(str(folder / name), f"{root}/{name}")
        digests = {name: sha256_file(folder / name) for name in names}
        system.pipe_file(f"{root}/{LISTING}", canonical_json(digests).encode())
    return sum((folder / name).stat().st_size for name in names)


def pull_store(address: str, folder: str | Path) -> int:
    """Fetch the store at ``address`` as ``folder``, whole or not at all; the number of bytes.

    Raises MissingResource where there is none, BadInput for a file whose bytes are not those that were sent.
    """
    with _reached(address) as (system, root), atomic_folder(folder) as partial:
        if not system.exists(f"{root}/{LISTING}"):
            raise MissingResource(f"{address} holds no store, or one that is being sent: it has no {LISTING}")
        system.get_file(f"{root}/{LISTING}", str(partial / LISTING))
        listing = read_json(partial / LISTING)
        digests: dict[str, str] = dict(listing.check(dict.fromkeys(listing, str)))
        (partial / LISTING).unlink()
        for name, digest in digests.items():
            path = partial / name
            if not path.resolve().is_relative_to(partial.resolve()):
                raise BadInput(address, "files inside the store", name, REMEDY)
            path.parent.mkdir(parents=True, exist_ok=True)
            system.get_file(f"{root}/{name}", str(path))
            if sha256_file(path) != digest:
                raise BadInput(f"{address}/{name}", f"SHA-256 {digest[:12]}", "other bytes", REMEDY)
        read_info(partial)
        return sum((partial / name).stat().st_size for name in digests)


@contextmanager
def _reached(address: str) -> Iterator[tuple[Any, str]]:
    """The file system of an address, and the path in it; what it raises becomes BadInput."""
    import fsspec

    try:
        system, root = fsspec.core.url_to_fs(address)
    except ImportError as error:
        raise MissingResource(f"{address}: {error}; for s3 addresses: pip install 'hoidata[s3]'") from error
    except ValueError as error:
        raise BadInput(address, "an address fsspec knows", str(error), "correct it") from error
    system.invalidate_cache()
    try:
        yield system, root.rstrip("/")
    except (BadInput, MissingResource):
        raise
    except Exception as error:  # clients of object stores raise what they like
        got = f"{type(error).__name__}: {error}"[:300]
        raise BadInput(address, "a place that can be reached", got, REMEDY) from error
