"""Files written whole or not at all, read without executing anything, and known by their content."""

from hoidata.files.atomic import atomic_file, atomic_folder
from hoidata.files.digest import canonical_json, sha256_bytes, sha256_file

__all__ = ["atomic_file", "atomic_folder", "canonical_json", "sha256_bytes", "sha256_file"]
