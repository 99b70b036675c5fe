"""`hoidata validate`: files that differ from dvc.lock, checkpoints with a wrong checksum, faults of stores."""

from pathlib import Path

from hoidata.errors import BadInput, MissingResource
from hoidata.files.checksums import corrupted_part
from hoidata.files.written import REMEDY
from pipelines.lineage.locks import Locked, other_files, read_locks
from pipelines.stages.base import empty_reason


def problems_of(path: Path) -> tuple[list[BadInput], str]:
    """All problems of an output, and a summary to print if there are none."""
    outputs = _outputs_at(path)
    problems = [item for root, lock, out in outputs for item in _changed_files(root, lock, out, path)]
    files = [file for file in ([path] if path.is_file() else sorted(path.rglob("*"))) if file.suffix == ".safetensors"]
    problems += [problem for file in files if (problem := _broken_seal(file))]
    summary = f"as written by {', '.join(lock.name for _, lock, _ in outputs[:3])}{' and others' * (len(outputs) > 3)}"
    if not (path / "meta").is_dir():
        if not outputs and not files:
            raise MissingResource(f"{path} is not a store, checkpoint or output of a stage; name one of these")
        return problems, summary if outputs else "sound"
    if reason := empty_reason(path):
        return problems, f"empty, {reason}"
    from hoidata.store.store import open_store
    from hoidata.store_check.check import check_store

    try:
        problems += check_store(path)
        opened = open_store(path)
    except BadInput as error:
        return problems or [error], ""
    return problems, f"sound, {len(opened)} clips, schema {opened.info['schema_version']}"


def _outputs_at(path: Path) -> list[tuple[Path, Locked, str]]:
    """Project, stage and output of all outputs at the path, below it or around it."""
    root = next((folder for folder in path.parents if (folder / "dvc.lock").is_file()), None)
    if root is None:
        return []
    name = path.relative_to(root)
    outs = [(root, lock, out) for lock in read_locks(root).values() for out in lock.outs if lock.name != "code"]
    return [item for item in outs if name.is_relative_to(item[2]) or Path(item[2]).is_relative_to(name)]


def _changed_files(root: Path, lock: Locked, out: str, path: Path) -> list[BadInput]:
    """The files of an output at the path that differ from what its stage wrote."""
    changed = (root / name for name in other_files(root, lock, out))
    concerned = [file for file in changed if file.is_relative_to(path) or path.is_relative_to(file)]
    return [BadInput(file, f"the bytes {lock.name} wrote, by dvc.lock", "others", REMEDY) for file in concerned]


def _broken_seal(file: Path) -> BadInput | None:
    try:
        fault = corrupted_part(file)
    except BadInput as error:
        return error
    return BadInput(file, f"the {fault} it was written with, by its own digest", "others", REMEDY) if fault else None
