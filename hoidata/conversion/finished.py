"""Saves the finished sequences of a conversion next to the store until it is complete, so that a killed run resumes.

    .clips.work/job.json             everything that determines the results: adapter, settings, hands, schema, code
    .clips.work/sequences/<key>.npz  state of the source files when they were read, results and arrays (see ``Packer``)
    .clips.work/shared/<sha256>.npz  a mesh or hand template that several sequences may share

Workers write each file atomically; results never pass between processes. Results are JSON values and arrays, exact in
every bit, without pickles. A dataclass becomes ``{"kind": name, "fields": ...}``, and an array the name of a member.
"""

import inspect
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import BodyTrack, CameraTrack, Clip, HandTrack, ObjectTrack, SourceContact, SourceFile
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.recording import HandRecording, SourceHandTrack
from hoidata.datasets.base import Adapter, SequenceKey
from hoidata.datasets.registry import FACTS
from hoidata.errors import BadInput
from hoidata.files import canonical_json, sha256_bytes, sha256_file
from hoidata.files.arrays import read_npz, write_npz
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import JointCapsules, Skin, TrackedHand
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.store.store import SCHEMA_VERSION

KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(Clip, HandTrack, ObjectTrack, CameraTrack, BodyTrack, SourceContact, SourceFile),
        *(ObjectModel, Hinge, Quarantined),
        *(HandRecording, SourceHandTrack, TrackedHand, Skin, JointCapsules, RigidTransform),
    )
}
SHARED = {("ObjectModel", "vertices_m"), ("ObjectModel", "faces"), ("ObjectModel", "part"), ("HandTrack", "template_m")}


class Packer:
    """Converts values to JSON and collects their named arrays."""

    def __init__(self, store_shared: Callable[[np.ndarray], str]) -> None:
        """store_shared: stores an array outside of ``arrays`` and returns its name."""
        self.store_shared = store_shared
        self.arrays: dict[str, np.ndarray] = {}
        self._shared: dict[int, tuple[np.ndarray, str]] = {}

    @property
    def shared(self) -> set[str]:
        """The names of the arrays stored outside of ``arrays``."""
        return {name for _, name in self._shared.values()}

    def pack(self, value: Any) -> Any:
        """``value`` as JSON values. Raises TypeError for types that clips do not contain."""
        if value is None or isinstance(value, bool | int | str) or type(value) is float:
            return value
        if isinstance(value, np.ndarray | np.generic):
            array, name = np.asarray(value), str(len(self.arrays))
            if array.dtype.hasobject:
                raise TypeError("an array of Python objects cannot be part of a clip")
            self.arrays[name] = array
            return {"array": name, "scalar": isinstance(value, np.generic)}
        if isinstance(value, dict):
            return {"dict": [[key, self.pack(item)] for key, item in value.items()]}
        if isinstance(value, tuple | list):
            return {type(value).__name__: [self.pack(item) for item in value]}
        name = type(value).__name__
        if KINDS.get(name) is not type(value):
            raise TypeError(f"a {name} cannot be part of a clip")
        return {"kind": name, "fields": {field.name: self._field(name, field.name, value) for field in fields(value)}}

    def _field(self, kind: str, name: str, owner: Any) -> Any:
        value = getattr(owner, name)
        if (kind, name) not in SHARED or value is None:
            return self.pack(value)
        # Clips of one sequence share one array object, which is digested once. The reference keeps its id unique.
        if id(value) not in self._shared:
            self._shared[id(value)] = value, self.store_shared(value)
        return {"shared": self._shared[id(value)][1]}


def unpack(value: Any, arrays: Mapping[str, np.ndarray], shared: Callable[[str], np.ndarray]) -> Any:
    """The inverse of ``Packer.pack``. shared: loads a shared array by its name.

    Raises KeyError, TypeError or ValueError for anything else.
    """
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]][()] if value["scalar"] else arrays[value["array"]]
    if "shared" in value:
        return shared(value["shared"])
    if "dict" in value:
        return {key: unpack(item, arrays, shared) for key, item in value["dict"]}
    if "kind" in value:
        parts = {name: unpack(item, arrays, shared) for name, item in value["fields"].items()}
        return KINDS[value["kind"]](**parts)
    items = [unpack(item, arrays, shared) for item in value["tuple" if "tuple" in value else "list"]]
    return tuple(items) if "tuple" in value else items


# Packages and modules of hoidata that a conversion runs; the digest of code also covers the adapter's file.
CODE_PATHS = (
    "conversion",
    "datasets",
    "store",
    "clips",
    "objects",
    "hands",
    "geometry",
    "files",
    "annotation",
    "contact",
    "workers.py",
    "errors.py",
)
LIBRARIES = ("numpy", "scipy", "torch", "trimesh")
_CACHED_ARRAYS = 32
Item = Clip | HandRecording | Quarantined


@dataclass(frozen=True)
class FinishedWork:
    """The folder of finished sequences of one job."""

    folder: Path
    root: Path  # of the raw files
    _arrays: dict[str, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def open(self, job: Mapping[str, Any]) -> None:
        """Keep the folder if it comes from an equal ``job``, else clear it. The caller has the lock ``exclusive``."""
        job_file, text = self.folder / "job.json", canonical_json(job)
        if not job_file.is_file() or job_file.read_text(encoding="utf-8") != text:
            self.remove()
            self.folder.mkdir(parents=True)
            job_file.write_text(text, encoding="utf-8")
        for name in ("sequences", "shared"):
            (self.folder / name).mkdir(exist_ok=True)
            for partial in (self.folder / name).glob(".*.part"):
                partial.unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete the folder. Renames it first, so that a kill does not leave a partial folder under its name."""
        dead = self.folder.with_suffix(".dead.part")  # a name that ``remove_leftovers`` deletes
        if self.folder.exists():
            shutil.rmtree(dead, ignore_errors=True)
            os.replace(self.folder, dead)
        shutil.rmtree(dead, ignore_errors=True)

    def save(self, key: SequenceKey, results: list[Item], sources: Sequence[SourceFile] | None) -> None:
        """Write the results of one sequence. sources: the files read; None if the next run must convert it again."""
        packer = Packer(self._share)
        try:
            packed = packer.pack(results)
            state = None if sources is None else self._state([source.path for source in sources])
            facts = _text(canonical_json({"state": state, "shared": sorted(packer.shared)}))
            members = {"sources": facts, "results": _text(json.dumps(packed)), **packer.arrays}
            write_npz(self._file(key), members)
        except OSError as error:
            remedy = "make room there and run again: finished sequences are kept"
            raise BadInput(self.folder, "a folder that can be written", str(error), remedy) from error

    def is_finished(self, key: SequenceKey) -> bool:
        """Whether the sequence is finished and its sources are unchanged."""
        try:
            # Opened here, because NumPy does not close a file that is not an archive.
            with open(self._file(key), "rb") as stream, np.load(stream, allow_pickle=False) as archive:
                saved = json.loads(archive["sources"].tobytes())
            if saved["state"] is None or not all(self._shared_file(name).is_file() for name in saved["shared"]):
                return False
            return saved["state"] == self._state(saved["state"]["files"])
        except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
            return False  # missing or damaged: the sequence is converted again

    def read(self, key: SequenceKey) -> list[Item]:
        """The results of one finished sequence, equal in every bit to those that were saved."""
        arrays = read_npz(self._file(key))
        return unpack(json.loads(arrays["results"].tobytes()), arrays, self._shared)

    def _file(self, key: SequenceKey) -> Path:
        return self.folder / "sequences" / f"{sha256_bytes(str(key).encode())[:32]}.npz"

    def _shared_file(self, name: str) -> Path:
        return self.folder / "shared" / f"{name}.npz"

    def _share(self, array: np.ndarray) -> str:
        head = f"{array.dtype.str}{array.shape}".encode()
        name = sha256_bytes(head + array.tobytes())
        if not self._shared_file(name).is_file():
            write_npz(self._shared_file(name), {"array": array})
        return name

    def _shared(self, name: str) -> np.ndarray:
        if name not in self._arrays:
            if len(self._arrays) >= _CACHED_ARRAYS:
                self._arrays.clear()
            self._arrays[name] = read_npz(self._shared_file(name))["array"]
        return self._arrays[name]

    def _state(self, paths: Iterable[str]) -> dict[str, Any]:
        """Sizes and times of the sources, and of the folders above them, which change when a file is added."""
        paths = sorted(paths)
        above = sorted({parent.as_posix() for path in paths for parent in Path(path).parents})
        return {
            "files": {path: _stamp(self.root / path) for path in paths},
            "folders": {path: os.stat(self.root / path).st_mtime_ns for path in above},
        }


def job_description(
    adapter: Adapter,
    hands: HandPair,
    root: Path,
    keys: Sequence[SequenceKey],
    manifest: Mapping[str, SourceFile] | None,
    synthetic: bool,
) -> dict[str, Any]:
    """Everything that determines the results of a conversion except the raw files, as JSON values."""
    kind = type(adapter)
    listed = None if manifest is None else [[path, manifest[path].sha256] for path in sorted(manifest)]
    return {
        "adapter": f"{kind.__module__}:{kind.__qualname__}",
        "settings": {name: repr(value) for name, value in sorted(_settings(adapter).items())},
        "facts": {name: repr(getattr(adapter, name)) for name in FACTS},
        "hands": hands.digest,
        "schema": SCHEMA_VERSION,
        "code": _code_digest(kind),
        "libraries": {name: version(name) for name in LIBRARIES},
        "root": str(root.resolve()),
        "keys": sha256_bytes("\n".join(map(str, keys)).encode()),
        "manifest": None if listed is None else sha256_bytes(canonical_json(listed).encode()),
        "synthetic": synthetic,
    }


def _settings(adapter: Adapter) -> dict[str, Any]:
    try:
        return {item.name: getattr(adapter, item.name) for item in fields(adapter)}  # type: ignore[arg-type]
    except TypeError:  # no dataclass
        return vars(adapter)


def _code_digest(kind: type) -> str:
    """Digest of every Python file in ``CODE_PATHS`` and of the files of the adapter's classes."""
    package_folder = Path(__file__).parents[1]
    code = [package_folder / name for name in CODE_PATHS]
    files = {file for path in code for file in ([path] if path.suffix == ".py" else path.rglob("*.py"))}
    for ancestor in kind.__mro__[:-1]:
        try:
            files.add(Path(inspect.getfile(ancestor)))
        except (TypeError, OSError):  # built into Python, or defined in an interactive session
            continue
    return sha256_bytes("".join(f"{sha256_file(path)}  {path}\n" for path in sorted(files)).encode())


def _stamp(path: Path) -> Any:
    """Size and time of a file. For a folder of frame files: the digest of sizes and times of its files."""
    status = os.stat(path)
    if not path.is_dir():
        return [status.st_size, status.st_mtime_ns]
    with os.scandir(path) as items:
        lines = sorted(f"{item.name} {item.stat().st_size} {item.stat().st_mtime_ns}" for item in items)
    return sha256_bytes("\n".join(lines).encode())


def _text(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)
