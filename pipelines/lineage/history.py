"""Queries to git: uncommitted files, the versions of a file, and the commit that added a text."""

import subprocess
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path

MAX_COMMITS = 500


class History:
    """The git repository at ``root``; all queries return empty results if it does not exist or has no commit."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def _git(self, *arguments: str) -> bytes:
        try:
            return subprocess.run(["git", *arguments], cwd=self._root, capture_output=True, check=True).stdout
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
        """Commit, path and content of all versions of some files, of each file the newest first."""
        for path in paths if self.exists else ():
            for commit in self._git("log", f"-n{MAX_COMMITS}", "--format=%H", "--", path).decode().split():
                if content := self.text(commit, path):
                    yield commit, path, content

    def commit_with(self, text: str, files: Iterable[str]) -> str | None:
        """The oldest commit that added ``text`` to one of ``files``."""
        if not self.exists:
            return None
        commits = self._git("log", "--format=%H", "--reverse", f"-S{text}", "--", *files).decode().split()
        return commits[0] if commits else None
