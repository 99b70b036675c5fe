"""Queries to git: uncommitted files, and the commits that had a recorded file or parameter."""

import hashlib
import subprocess
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path

MAX_COMMITS = 500


class History:
    """The git repository at ``root``; all queries return empty results if it does not exist or has no commit."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def _git(self, *arguments: str, stdin: bytes = b"") -> bytes:
        try:
            command = ["git", "-c", "core.quotepath=off", *arguments]
            return subprocess.run(command, cwd=self._root, input=stdin, capture_output=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError):
            return b""

    @cached_property
    def exists(self) -> bool:
        """Whether the project is the top of a repository with at least one commit."""
        lines = self._git("rev-parse", "--show-toplevel", "--verify", "HEAD").decode().splitlines()
        return len(lines) == 2 and Path(lines[0]).resolve() == self._root.resolve()

    @cached_property
    def uncommitted(self) -> frozenset[str]:
        """Paths that differ from the last commit or are new; files that git ignores do not count."""
        if not self.exists:
            return frozenset()
        entries = self._git("status", "--porcelain", "-z", "--untracked-files=all", "--no-renames").decode().split("\0")
        return frozenset(entry[3:] for entry in entries if entry)

    def text(self, commit: str, path: str) -> bytes:
        """The content of a file in a commit; empty if it does not exist."""
        return self._git("show", f"{commit}:{path}")

    def versions(self, paths: Iterable[str]) -> Iterator[tuple[str, str, bytes]]:
        """Commit, path and content of all versions of some files, newest first."""
        named = list(paths)
        if not (named and self.exists):
            return
        log = self._git("log", f"-n{MAX_COMMITS}", "--raw", "--no-abbrev", "--no-renames", "--format=%H", "--", *named)
        commit, entries = "", []
        for line in log.decode().splitlines():
            if line.startswith(":"):
                fields, _, path = line.partition("\t")
                entries.append((commit, path, fields.split()[3]))
            elif line:
                commit = line
        contents = self._blobs([blob for _, _, blob in entries])
        yield from ((commit, path, contents[blob]) for commit, path, blob in entries if blob in contents)

    def commits_of(self, digests: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
        """The newest commit that has each (path, SHA-256); pairs that no commit has are omitted."""
        requested, commits = set(digests), {}
        for commit, path, content in self.versions({path for path, _ in requested}):
            key = (path, hashlib.sha256(content).hexdigest())
            if key in requested:
                commits.setdefault(key, commit[:10])
        return commits

    def commit_with(self, text: str, files: Iterable[str]) -> str | None:
        """The oldest commit that added ``text`` to one of ``files``."""
        if not self.exists:
            return None
        commits = self._git("log", "--format=%H", "--reverse", f"-S{text}", "--", *files).decode().split()
        return commits[0] if commits else None

    def _blobs(self, names: list[str]) -> dict[str, bytes]:
        data, contents, start = self._git("cat-file", "--batch", stdin="\n".join(names).encode()), {}, 0
        while start < len(data):
            end = data.index(b"\n", start)
            name, kind, *size = data[start:end].decode().split()
            start = end + 1
            if kind == "blob":
                contents[name] = data[start : start + int(size[0])]
                start += int(size[0]) + 1
        return contents
