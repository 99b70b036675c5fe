"""`hoidata lineage rerun`: train a checkpoint again in a clean clone, and compare the weights."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from hoidata.errors import BadInput, HoidataError
from hoidata.files.checksums import payload_digest
from hoidata.lifetime import end_with_parent
from hoidata.machine_folder import SETTINGS
from pipelines.lineage.locks import read_locks
from pipelines.lineage.targets import WEIGHTS, Target


def rerun(root: Path, target: Target, commit: str = "HEAD") -> tuple[str, str]:
    """The digest of a checkpoint's weights, and that of the same stage run again with the code of a commit.

    The clone gets this project's inputs and profile, and the settings of the commit. Raises BadInput if the target is
    not a checkpoint of this project, HoidataError if the stage fails.
    """
    stage = target.record.get("stage", "")
    out = Path(target.name).parent
    arguments = _arguments(root, out.as_posix(), stage)
    if target.kind != "checkpoint" or not arguments:
        remedy = "name one below checkpoints/"
        raise BadInput(target.name, "a checkpoint of a stage of this project", target.kind, remedy)
    with TemporaryDirectory(prefix="hoidata-rerun-") as folder:
        clone = Path(folder) / "clone"
        _run(root, "git", "clone", "--quiet", "--no-hardlinks", str(root.resolve()), str(clone))
        _run(clone, "git", "checkout", "--quiet", _resolved(root, commit))
        _link_inputs(root, clone, out)
        _run(clone, *stage_command(clone), "code")
        _run(clone, *stage_command(clone), *arguments)
        return payload_digest(root / target.name), payload_digest(clone / out / WEIGHTS)


def stage_command(project: Path) -> tuple[str, ...]:
    """The command that runs a stage: the code of the project folder if it is a clone, else the installed hoidata."""
    module = ["pipelines.stages"] if (project / "pipelines").is_dir() else ["hoidata", "stage"]
    return (sys.executable, "-m", *module)


def _arguments(root: Path, out: str, stage: str) -> list[str]:
    """The arguments of ``pipelines.stages`` that write the checkpoint in ``out``; empty if no stage does."""
    parts = Path(out).parts
    if len(parts) != 4 or parts[0] != "checkpoints" or stage not in read_locks(root):
        return []
    return ["train", "--profile", parts[1], "--dataset", parts[2], "--model", parts[3]]


def _resolved(root: Path, commit: str) -> str:
    command = ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"]
    result = subprocess.run(command, cwd=root, capture_output=True, text=True)
    if result.returncode:
        raise BadInput(commit, "a commit of this project", "none", "name one that `git log` shows")
    return result.stdout.strip()


def _link_inputs(root: Path, clone: Path, out: Path) -> None:
    """Link data, manifests, hoidata.toml and the other checkpoints into the clone, and set its profile."""
    from pipelines.params import read_params

    _, profile, dataset, _ = out.parts
    chosen, params = read_params(root)["profile"], clone / "params.yaml"
    text = params.read_text()
    params.write_text(text.replace(f"profile: {read_params(clone)['profile']}", f"profile: {chosen}", 1))
    links = [Path("data") / profile / dataset, Path("manifests") / profile, Path(SETTINGS)]
    links += [path.relative_to(root) for path in (root / out.parent).iterdir() if path.name != out.name]
    for path in links:
        if (root / path).exists() and not (clone / path).exists():
            (clone / path).parent.mkdir(parents=True, exist_ok=True)
            (clone / path).symlink_to((root / path).resolve())


def _run(folder: Path, *command: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(folder.resolve())}
    end_with_caller = partial(end_with_parent, os.getpid())
    run = partial(subprocess.run, capture_output=True, text=True)
    result = run(command, cwd=folder, env=environment, preexec_fn=end_with_caller)
    if result.returncode:
        lines = (result.stderr or result.stdout).strip().splitlines()
        raise HoidataError(f"{' '.join(command)}: exit code {result.returncode}: {lines[-1] if lines else ''}")
