"""The import closure of a module: all files its imports reach, also imports in functions, and the packages' data files.

Imports are parsed from the source; no code runs. A ``Choice`` states what a module imports or reads dynamically.
"""

import ast
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from itertools import accumulate
from pathlib import Path

from hoidata.files.atomic import sha256_file, write_whole
from hoidata.package_paths import INSTALLED, package_home

# An import statement: the module after ``from`` or None, the number of leading dots, the names.
Statement = tuple[str | None, int, list[str]]
CACHED_IMPORTS = Path(".hoidata/imports.json")
OWN_PACKAGES = ("hoidata", "models", "pipelines")
ENTRY_POINT_GROUPS = ("hoidata.adapters", "hoidata.families")
# Files in packages that no module reads.
NOT_DATA = ("*.py", "*.pyc", "*.md", "dvc.yaml", "dvc.lock", ".*")


@dataclass(frozen=True)
class Choice:
    """The modules and files that a module selects at run time, such as the adapter of one dataset."""

    modules: tuple[str, ...] = ()  # imported by name
    package: str = ""  # in whose folder ``files`` are
    files: tuple[str, ...] = ()  # glob patterns of files that are read
    is_registry: bool = False  # the module lists more than is selected, so its text does not count, only the selection


class SourceTree:
    """The source files of the project's packages and of packages with entry points; each file is read once.

    Parsed imports are cached in ``.hoidata`` by the digest of the file, since parsing takes ten times as long.

    Args:
        outside: folders of packages outside of the project, by name (``hoidata.datasets.kitchen``).
    """

    def __init__(self, root: Path, outside: Mapping[str, Path] | None = None) -> None:
        self._root, self._outside = root, outside or {}
        self._cached_imports = _read_imports(root / CACHED_IMPORTS)
        self._parsed_imports: dict[str, list[Statement]] = {}
        self._sources: dict[str, Path | None] = {}
        self._imports: dict[str, tuple[str, ...]] = {}
        self._data: dict[str, list[tuple[str, Path]]] = {}
        self._digest = cache(sha256_file)

    def closure(self, start: Iterable[str], chosen: Mapping[str, Iterable[Choice]]) -> dict[str, str]:
        """SHA-256 of each file in the import closure, by its path as the import system sees it.

        A data file that some choice names counts only if that choice's module is reached. All other data files count
        with their package. Third-party packages with entry points are listed with their version.
        """
        reached = self._reached(start, chosen)
        sources = {name: source for name in reached if (source := self._source(name))}
        registries = {module for module, choices in chosen.items() if any(choice.is_registry for choice in choices)}
        files = {self._key(name, source): source for name, source in sources.items() if name not in registries}
        picked = {module: dict(self._picked(choices)) for module, choices in chosen.items()}
        claimed = {key for picked_files in picked.values() for key in picked_files}
        data = (item for name in sources for item in self._data_of(name))
        files |= {key: path for key, path in data if key not in claimed}
        for module in picked.keys() & sources.keys():
            files |= picked[module]
        digests = {key: self._digest(path) for key, path in files.items()}
        return digests | {key: version for name in sources for key, version in self._distribution(name).items()}

    def save_imports(self) -> None:
        """Write the cache of parsed imports if it has grown; a read-only folder is not an error."""
        path = self._root / CACHED_IMPORTS
        if path.parent.is_dir() and not self._parsed_imports.keys() <= self._cached_imports.keys():
            imports = self._cached_imports | self._parsed_imports
            with suppress(OSError):
                write_whole(path, json.dumps({"scanner": sha256_file(__file__), "imports": imports}))

    def modules_below(self, package: str) -> list[str]:
        """The names of all modules in a package, sorted; empty if there is no such folder."""
        folder = self._folder(package)
        paths = sorted(folder.rglob("*.py")) if folder else ()
        names = (".".join((package, *path.relative_to(folder).with_suffix("").parts)) for path in paths if folder)
        return [name.removesuffix(".__init__") for name in names]

    def entry_point_modules(self, group: str, name: str) -> list[str]:
        """The modules that other packages register under ``name``."""
        return [point.module for point in self._entry_points if (point.group, point.name) == (group, name)]

    def _reached(self, start: Iterable[str], chosen: Mapping[str, Iterable[Choice]]) -> list[str]:
        order = dict.fromkeys(start)
        waiting = list(order)
        while waiting:
            name = waiting.pop()
            picked = (module for choice in chosen.get(name, ()) for module in choice.modules)
            new = [imported for imported in (*self._imported(name), *picked) if imported not in order]
            order.update(dict.fromkeys(new))
            waiting += new
        return sorted(order)

    def _imported(self, name: str) -> tuple[str, ...]:
        """The parent packages of a module and all names in its imports, some of which are not modules."""
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
        if digest not in self._parsed_imports:
            cached = self._cached_imports.get(digest)
            self._parsed_imports[digest] = list(_imports(ast.parse(source.read_bytes()))) if cached is None else cached
        return self._parsed_imports[digest]

    def _folder(self, package: str) -> Path | None:
        """The folder of a package; for a module, the path without suffix. None for packages that do not count."""
        for name, folder in self._outside.items():
            if package == name or package.startswith(f"{name}."):
                return folder.joinpath(*package.removeprefix(name).split(".")[1:])
        home = self._homes.get(package.partition(".")[0])
        return home.joinpath(*package.split(".")) if home else None

    def _source(self, name: str) -> Path | None:
        """The source file of a module; None for packages that do not count and for names that are not modules."""
        if name not in self._sources:
            base = self._folder(name)
            candidates = (base / "__init__.py", base.with_suffix(".py")) if base else ()
            self._sources[name] = next((path for path in candidates if path.is_file()), None)
        return self._sources[name]

    @cached_property
    def _homes(self) -> dict[str, Path]:
        """The parent folder of each top-level package: the project, or the place where it is installed."""
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
        """Name and version of the third-party distribution that a module belongs to."""
        top = name.partition(".")[0]
        points = () if top in OWN_PACKAGES else self._entry_points
        dists = [point.dist for point in points if point.dist and point.module.partition(".")[0] == top]
        return {f"distribution {dist.name}": dist.version for dist in dists}

    def _key(self, name: str, source: Path) -> str:
        return f"{name.replace('.', '/')}{'/__init__' if source.name == '__init__.py' else ''}.py"

    def _picked(self, choices: Iterable[Choice]) -> Iterator[tuple[str, Path]]:
        for choice in choices:
            if folder := self._folder(choice.package):
                paths = (path for pattern in choice.files for path in sorted(folder.glob(pattern)))
                yield from ((_below(choice.package, folder, path), path) for path in paths)

    def _data_of(self, name: str) -> list[tuple[str, Path]]:
        """The data files of a module's package: in its folder, and in subfolders without modules."""
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
    """The cached imports by the digest of the source file; empty if another version of this module wrote them."""
    try:
        values = json.loads(path.read_bytes())
        imports = values["imports"].items() if values["scanner"] == sha256_file(__file__) else ()
        return {
            digest: [(base, int(level), list(names)) for base, level, names in modules] for digest, modules in imports
        }
    except (OSError, ValueError, TypeError, AttributeError, KeyError):
        return {}


def _imports(tree: ast.AST) -> Iterator[Statement]:
    """All import statements except those for type checkers only."""
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
    """The modules that a statement may import; of ``from a import b`` both a and a.b, since b may be a module."""
    base, level, names = statement
    if base is None:
        return names
    if level:
        above = package.split(".")[: len(package.split(".")) - level + 1]
        base = ".".join(filter(None, [*above, base]))
    return [base, *(f"{base}.{name}" for name in names)]
