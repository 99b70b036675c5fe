"""What a wheel holds: hoidata and, inside it as hoidata/installed, the packages next to it here.

So an installation takes one name of Python's, not three: a user's own ``models`` and ``pipelines`` stay theirs.
``hoidata/package_paths.py`` finds these packages in a clone and in an installation.
"""

from setuptools import find_packages, setup

INSTALLED = "hoidata.installed"
DATA = ["npz", "csv", "html", "json", "toml", "js", "css", "md"]
GRAPHS = ["dvc.yaml", "pipelines/dvc.yaml", "models/*/dvc.yaml"]
PROJECT = ["params.yaml", "prefect.toml", ".dvcignore", ".gitignore"]
FOLDERS = [".dvc/config", ".dvc/.gitignore", "manifests/embedded/*.json", "manifests/study/*.json", *GRAPHS]

own = find_packages(include=["hoidata*"])
inside = [f"{INSTALLED}.{name}" for name in find_packages(include=["models*", "pipelines*"])]
data = [*(f"**/*.{suffix}" for suffix in DATA), "vendor/LICENSE-three"]
setup(
    packages=[*own, INSTALLED, *inside],
    package_dir={INSTALLED: "."},
    package_data={**dict.fromkeys([*own, *inside], data), INSTALLED: [*PROJECT, *FOLDERS]},
    exclude_package_data={INSTALLED: ["setup.py", "pyproject.toml"]},
)
