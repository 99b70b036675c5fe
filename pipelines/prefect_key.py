"""The key to this project's Prefect server: who has it can have the server's worker run code as you.

`hoidata up` writes a new one at every start into ``.prefect/``, for the owner alone; `prefect` typed in this folder
reads it there (``prefect_names``). It never stands in an argument, a log or a committed file.
"""

import os
import secrets
import stat
import tempfile
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

KEY_FILE = Path(".prefect/api-key")


def write_key(path: Path = KEY_FILE) -> str:
    """Put a new key in the place of the one before; returns it. Its folder is closed to other users first.

    A key that others may have read, or that was sent to a stranger's server while ours was down, is worth nothing
    from then on.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    path.parent.chmod(0o700)
    key = f"hoidata:{secrets.token_urlsafe(32)}"
    handle, partial = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)  # mode 0600
    with os.fdopen(handle, "w") as stream:
        stream.write(key)
    os.replace(partial, path)
    return key


def read_key(path: Path = KEY_FILE) -> str | None:
    """The key; None where no server was started. Raises PermissionError when others can read it or wrote it."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    with os.fdopen(descriptor) as stream:
        found = os.fstat(descriptor)
        if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) & 0o077:
            raise PermissionError(f"{path}: expected a file of mode 0600 that is yours; `hoidata up` makes a new one")
        return stream.read()


def is_loopback(url: str | None) -> bool:
    """Whether an address is a port of this machine out of reach for others; "localhost" is a name, and may be two."""
    try:
        address = urlsplit(url or "")
        return bool(address.port) and ip_address(address.hostname or "").is_loopback
    except ValueError:
        return False
