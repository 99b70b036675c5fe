"""The wheel of the working tree."""

import shutil
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).parents[2]
OURS = ("hoidata", "models", "pipelines")
BESIDE = (
    *("pyproject.toml", "setup.py", "dvc.yaml", "params.yaml", "prefect.toml", "manifests", "README.md", "NOTICE"),
    *("LICENSE*", ".dvc", ".dvcignore", ".gitignore"),
)


def build_wheel(folder: Path) -> Path:
    """Build the wheel from the files that git does not ignore, into ``folder``."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *OURS, *BESIDE]
    files = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, files.split("\0")):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PROJECT / name, folder / "source" / name)
    build = f"from setuptools.build_meta import build_wheel; build_wheel({str(folder)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=folder / "source", check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel
