"""The exact code behind a module: every file its imports reach, those inside functions too, and the data beside them.

Imports are read from the source and nothing is run; what a module picks by name is told in a ``Choice``.
"""

import ast
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path

from hoidata.files.atomic import sha256_file, write_whole
from hoidata.package_paths import INSTALLED, package_home

# An import statement: the module after ``from`` or None, how many folders up, the names.
Statement = tuple[str | None, int, list[str]]
KNOWN_IMPORTS = Path(".hoidata/imports.json")
OWN_PACKAGES = ("hoidata", "models", "pipelines")
ENTRY_POINT_GROUPS = ("hoidata.adapters", "hoidata.families")
# Lie in packages, and no module reads them.
NOT_DATA = ("*.py", "*.pyc", "*.md", "dvc.yaml", "dvc.lock", ".*")


@dataclass(frozen=True)
class Choice:
    """What one module picks by name: modules it imports and, as glob patterns in a package's folder, files it reads.

    is_table: the module names much that is not picked here, so its own text does not count, only what it picks.
    """

    modules: tuple[str, ...] = ()
    package: str = ""
    files: tuple[str, ...] = ()
    is_table: bool = False


class SourceTree:
    """The packages of the project at ``root`` and those that entry points add; each file is read once.

    outside: packages whose folder lies elsewhere, by name (``hoidata.datasets.kitchen``). What a file imports is kept
    by the file's digest in ``.hoidata``, which may be deleted: parsing it again takes ten times as long.
    """

    def __init__(self, root: Path, outside: Mapping[str, Path] | None = None) -> None:
        self._root, self._outside = root, outside or {}
        self._known = _read_imports(root / KNOWN_IMPORTS)
        self._used: dict[str, list[Statement]] = {}
        self._sources: dict[str, Path | None] = {}
        self._imports: dict[str, tuple[str, ...]] = {}
        self._data: dict[str, list[tuple[str, Path]]] = {}
        self._digests: dict[Path, str] = {}

    def closure(self, start: Iterable[str], chosen: Mapping[str, Iterable[Choice]]) -> dict[str, str]:
        """SHA-256 of each file behind the modules ``start``, by its path as the import system sees it.

        chosen: by module what it picks by name. A file that some module picks counts where that module is reached;
        all other data files count with the package they lie in. Packages of others come with their version.
        """
        reached = self._reached(start, chosen)
        sources = {name: source for name in reached if (source := self._source(name))}
        tables = {by for by, choices in chosen.items() if any(choice.is_table for choice in choices)}
        found = {self._key(name, source): source for name, source in sources.items() if name not in tables}
        picked = {by: dict(self._picked(choices)) for by, choices in chosen.items()}
        claimed = {key for files in picked.values() for key in files}
        data = (item for name in sources for item in self._data_of(name))
        found |= {key: path for key, path in data if key not in claimed}
        for by in picked.keys() & sources.keys():
            found |= picked[by]
        digests = {key: self._digest(path) for key, path in found.items()}
        return digests | {key: version for name in sources for key, version in self._distribution(name).items()}

    def keep_imports(self) -> None:
        """Keep what was parsed for the next time, where that is new and can be written."""
        path = self._root / KNOWN_IMPORTS
        if path.parent.is_dir() and not self._used.keys() <= self._known.keys():
            with suppress(OSError):
                write_whole(path, json.dumps({"scanner": _scanner(), "imports": self._known | self._used}))

    def modules_below(self, package: str) -> list[str]:
        """All modules of a package of the project, sorted; none where there is no such folder."""
        folder = self._folder(package)
        paths = sorted(folder.rglob("*.py")) if folder else ()
        names = (".".join((package, *path.relative_to(folder).with_suffix("").parts)) for path in paths if folder)
        return [name.removesuffix(".__init__") for name in names]

    def added(self, group: str, name: str) -> list[str]:
        """The modules that other packages register under ``name``."""
        return [point.module for point in self._entry_points if (point.group, point.name) == (group, name)]

    def _reached(self, start: Iterable[str], chosen: Mapping[str, Iterable[Choice]]) -> list[str]:
        order = dict.fromkeys(start)
        waiting = list(order)
        while waiting:
            name = waiting.pop()
            picked = (module for choice in chosen.get(name, ()) for module in choice.modules)
            new = [found for found in (*self._imported(name), *picked) if found not in order]
            order.update(dict.fromkeys(new))
            waiting += new
        return sorted(order)

    def _imported(self, name: str) -> tuple[str, ...]:
        """The packages a module lies in and all that its imports name, also what turns out to be no module."""
        if name not in self._imports:
            source = self._source(name)
            statements = self._statements(source) if source else ()
            package = name if source and source.name == "__init__.py" else name.rpartition(".")[0]
            named = {item for statement in statements for item in _named(statement, package)}
            # Importing a.b.c runs a, a.b and a.b.c.
            chains = (accumulate(item.split("."), "{}.{}".format) for item in {*named, name})
            self._imports[name] = tuple(sorted(set().union(*chains)))
        return self._imports[name]

    def _statements(self, source: Path) -> list[Statement]:
        digest = self._digest(source)
        if digest not in self._used:
            known = self._known.get(digest)
            self._used[digest] = list(_imports(ast.parse(source.read_bytes()))) if known is None else known
        return self._used[digest]

    def _folder(self, package: str) -> Path | None:
        """Where the files of a package lie, if it is one that counts; also of a package that is a single module."""
        for name, folder in self._outside.items():
            if package == name or package.startswith(f"{name}."):
                return folder.joinpath(*package.removeprefix(name).split(".")[1:])
        home = self._homes.get(package.partition(".")[0])
        return home.joinpath(*package.split(".")) if home else None

    def _source(self, name: str) -> Path | None:
        """The file of a module that counts; None for others and for what is no module."""
        if name not in self._sources:
            base = self._folder(name)
            candidates = (base / "__init__.py", base.with_suffix(".py")) if base else ()
            self._sources[name] = next((path for path in candidates if path.is_file()), None)
        return self._sources[name]

    @cached_property
    def _homes(self) -> dict[str, Path]:
        """The folder each package lies in: the project, or where a package of others is installed."""
        homes: dict[str, Path] = {name: package_home(name, self._root) for name in OWN_PACKAGES}
        for point in self._entry_points:
            top = point.module.partition(".")[0]
            spec = None if top in homes else find_spec(top)
            if spec and spec.origin:
                origin = Path(spec.origin)
                homes[top] = origin.parent.parent if spec.submodule_search_locations else origin.parent
        return homes

    @cached_property
    def _entry_points(self) -> list[EntryPoint]:
        points = entry_points()
        return [point for group in ENTRY_POINT_GROUPS for point in points.select(group=group)]

    def _distribution(self, name: str) -> dict[str, str]:
        """Name and version of the package of others that a module belongs to."""
        top = name.partition(".")[0]
        points = () if top in OWN_PACKAGES else self._entry_points
        dists = [point.dist for point in points if point.dist and point.module.partition(".")[0] == top]
        return {f"distribution {dist.name}": dist.version for dist in dists}

    def _key(self, name: str, source: Path) -> str:
        return f"{name.replace('.', '/')}{'/__init__' if source.name == '__init__.py' else ''}.py"

    def _digest(self, path: Path) -> str:
        if path not in self._digests:
            self._digests[path] = sha256_file(path)
        return self._digests[path]

    def _picked(self, choices: Iterable[Choice]) -> Iterator[tuple[str, Path]]:
        for choice in choices:
            if folder := self._folder(choice.package):
                paths = (path for pattern in choice.files for path in sorted(folder.glob(pattern)))
                yield from ((_below(choice.package, folder, path), path) for path in paths)

    def _data_of(self, name: str) -> list[tuple[str, Path]]:
        """The data files of a module's package: in its folder, and in folders below that hold no modules."""
        source = self._source(name)
        package = name if source and source.name == "__init__.py" else name.rpartition(".")[0]
        if package not in self._data:
            folder = self._folder(package) if package else None
            paths = sorted(_data_files(folder)) if folder else ()
            self._data[package] = [(_below(package, folder, path), path) for path in paths if folder]
        return self._data[package]


def _below(package: str, folder: Path, path: Path) -> str:
    return f"{package.replace('.', '/')}/{path.relative_to(folder).as_posix()}"


def _data_files(folder: Path) -> Iterator[Path]:
    for item in folder.iterdir():
        if item.is_dir():
            if item.name not in ("__pycache__", INSTALLED) and not any(item.glob("*.py")):
                yield from _data_files(item)
        elif not any(item.match(pattern) for pattern in NOT_DATA):
            yield item


def _read_imports(path: Path) -> dict[str, list[Statement]]:
    """What was kept, by the digest of the file that imports it; nothing of what other code than this kept."""
    try:
        values = json.loads(path.read_bytes())
        known = values["imports"] if values["scanner"] == _scanner() else {}
        return {
            digest: [(base, int(level), list(names)) for base, level, names in found] for digest, found in known.items()
        }
    except (OSError, ValueError, TypeError, AttributeError, KeyError):
        return {}


def _scanner() -> str:
    return sha256_file(__file__)


def _imports(tree: ast.AST) -> Iterator[Statement]:
    """Every import statement, but for those that only a type checker follows."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield None, 0, [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            yield node.module or "", node.level, [alias.name for alias in node.names]
        elif isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            waiting += node.orelse
        else:
            below = ast.iter_child_nodes(node)
            waiting += [child for child in below if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case)]


def _named(statement: Statement, package: str) -> list[str]:
    """What a statement may import; of ``from a import b`` both, as b may be a module or something in a."""
    base, level, names = statement
    if base is None:
        return names
    if level:
        above = package.split(".")[: len(package.split(".")) - level + 1]
        base = ".".join(filter(None, [*above, base]))
    return [base, *(f"{base}.{name}" for name in names)]
