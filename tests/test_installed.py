"""The wheel in a new environment: it installs only the name hoidata, and gives the same bytes as a clone."""

import filecmp
import json
import os
import shutil
import subprocess
import sysconfig
import venv
from pathlib import Path

import pytest

from pipelines.stages.code import code_today
from tests.builders.wheel import OURS, build_wheel

PROJECT = Path(__file__).parents[1]
# Packages of the user, unrelated to hoidata.
USERS = "from models import mine\nfrom pipelines import own\nimport hoidata.errors\nprint(mine, own)"
BOTH = "import models\nfrom hoidata.package_paths import add_to_path\nadd_to_path()"


def run(python: Path, folder: Path, *words: str, **more: str) -> subprocess.CompletedProcess:
    variables = {key: value for key, value in os.environ.items() if not key.startswith(("HOIDATA_", "PYTHONPATH"))}
    path = f"{python.parent}{os.pathsep}{variables['PATH']}"
    environment = {**variables, "PATH": path, "OMP_NUM_THREADS": "1", "DVC_NO_ANALYTICS": "1", **more}
    return subprocess.run([python, *words], cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def python(tmp_path_factory) -> Path:
    """The Python of an environment with the wheel and the packages of this environment."""
    folder = tmp_path_factory.mktemp("installed")
    wheel = build_wheel(folder)
    venv.create(folder / "env", with_pip=True)
    python = folder / "env/bin/python"
    done = run(python, folder, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", str(wheel))
    assert done.returncode == 0, done.stderr
    (packages,) = (folder / "env").glob("lib/python*/site-packages")
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    _take_compiled(packages / "hoidata")
    return python


def _take_compiled(package: Path) -> None:
    """Copy numba's compiled code, and give the sources the modification times that it checks."""
    for cached in (path for name in OURS for path in (PROJECT / name).rglob("__pycache__/*.nb?")):
        source = cached.parents[1] / f"{cached.name.partition('.')[0]}.py"
        below = source.relative_to(PROJECT / "hoidata") if source.is_relative_to(PROJECT / "hoidata") else None
        for target in (package / below,) if below and source.is_file() else ():
            (target.parent / "__pycache__").mkdir(exist_ok=True)
            shutil.copy(cached, target.parent / "__pycache__")
            os.utime(target, ns=(source.stat().st_atime_ns, source.stat().st_mtime_ns))


@pytest.mark.long
def test_a_project_of_the_wheel_gives_the_bytes_of_a_clone(python, tmp_path, small_corpus):
    project = tmp_path / "project"
    assert run(python, tmp_path, "-m", "hoidata", "init", "project").returncode == 0
    for path in (project / "manifests/embedded").glob("*.json"):
        path.write_text(path.read_text().replace('"size": "full"', '"size": "small"'))
    done = run(python, project, "-m", "hoidata", "repro", "convert@embedded-h2o")
    assert done.returncode == 0, done.stdout + done.stderr
    reference, clips = small_corpus("h2o").clips, project / "data/embedded/h2o/clips"
    names = sorted(path.relative_to(reference) for path in reference.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(clips) for path in clips.rglob("*") if path.is_file())
    assert filecmp.cmpfiles(reference, clips, names, shallow=False)[1:] == ([], [])
    # Checkpoints have digests of the code, which must be equal in a clone and a wheel.
    for name, digests in code_today(PROJECT).items():
        assert json.loads((project / name).read_text()) == digests, name


@pytest.mark.long
def test_packages_of_the_user_called_models_and_pipelines_stay_theirs(python, tmp_path):
    for name in ("models", "pipelines"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("mine = own = 'the user'")
    assert run(python, tmp_path, "-c", USERS).stdout == "the user the user\n"
    assert run(python, tmp_path, "-m", "hoidata", "adapters", "list", PYTHONPATH=str(tmp_path)).returncode == 0
    assert "another package called models" in run(python, tmp_path, "-c", BOTH).stderr
