"""Atomic writes, content digests, and readers that never execute code of a file."""

from hoidata.files.atomic import (
    atomic_file,
    atomic_folder,
    canonical_json,
    remove_dead_leftovers,
    sha256_bytes,
    sha256_file,
    write_whole,
)
from hoidata.files.numpy_files import load_npy, load_npy_object, load_npz_objects
from hoidata.files.restricted_pickle import ARRAYS, Record, restricted_load
from hoidata.files.torch_pickle import load_torch_pickle

__all__ = [
    "ARRAYS",
    "Record",
    "atomic_file",
    "atomic_folder",
    "canonical_json",
    "load_npy",
    "load_npy_object",
    "load_npz_objects",
    "load_torch_pickle",
    "remove_dead_leftovers",
    "restricted_load",
    "sha256_bytes",
    "sha256_file",
    "write_whole",
]
