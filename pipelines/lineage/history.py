"""What git knows: what is not committed, and which commit held a file or a parameter as a checkpoint recorded it."""

import hashlib
import subprocess
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path

MOST_COMMITS = 500


class History:
    """The repository at ``root``; knows nothing where there is none, or no commit yet."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def _git(self, *words: str, stdin: bytes = b"") -> bytes:
        try:
            command = ["git", "-c", "core.quotepath=off", *words]
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
        """Paths that are not as in the last commit, new ones too; what git ignores does not count."""
        if not self.exists:
            return frozenset()
        entries = self._git("status", "--porcelain", "-z", "--untracked-files=all", "--no-renames").decode().split("\0")
        return frozenset(entry[3:] for entry in entries if entry)

    def text(self, commit: str, path: str) -> bytes:
        """A file as of a commit; empty when there is none."""
        return self._git("show", f"{commit}:{path}")

    def versions(self, paths: Iterable[str]) -> Iterator[tuple[str, str, bytes]]:
        """Commit, path and content of every version of some files, newest first."""
        named = list(paths)
        if not (named and self.exists):
            return
        log = self._git("log", f"-n{MOST_COMMITS}", "--raw", "--no-abbrev", "--no-renames", "--format=%H", "--", *named)
        commit, found = "", []
        for line in log.decode().splitlines():
            if line.startswith(":"):
                fields, _, path = line.partition("\t")
                found.append((commit, path, fields.split()[3]))
            elif line:
                commit = line
        contents = self._blobs([blob for _, _, blob in found])
        yield from ((commit, path, contents[blob]) for commit, path, blob in found if blob in contents)

    def commits_of(self, digests: Iterable[tuple[str, str]]) -> dict[tuple[str, str], str]:
        """The newest commit that held a file with a SHA-256, for each (path, digest) some commit held."""
        wanted, found = set(digests), {}
        for commit, path, content in self.versions({path for path, _ in wanted}):
            key = (path, hashlib.sha256(content).hexdigest())
            if key in wanted:
                found.setdefault(key, commit[:10])
        return found

    def commit_with(self, words: str, files: Iterable[str]) -> str | None:
        """The commit that brought ``words`` into one of ``files``; of several the oldest."""
        if not self.exists:
            return None
        commits = self._git("log", "--format=%H", "--reverse", f"-S{words}", "--", *files).decode().split()
        return commits[0] if commits else None

    def _blobs(self, names: list[str]) -> dict[str, bytes]:
        data, found, start = self._git("cat-file", "--batch", stdin="\n".join(names).encode()), {}, 0
        while start < len(data):
            end = data.index(b"\n", start)
            name, kind, *size = data[start:end].decode().split()
            start = end + 1
            if kind == "blob":
                found[name] = data[start : start + int(size[0])]
                start += int(size[0]) + 1
        return found
