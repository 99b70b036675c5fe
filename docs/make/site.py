"""MkDocs hook that adds pages made from the code and Markdown files outside of docs, and rewrites links to them."""

import os
import posixpath
import re
from pathlib import Path

from mkdocs.structure.files import File

from docs.make import reference

ROOT = Path(__file__).parents[2]
PAGES = {
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "hoidata/store/README.md": "reference/schema.md",
    "hoidata/metrics/README.md": "reference/metrics.md",
    "hoidata/datasets/CONVENTIONS.md": "reference/conventions.md",
    "hoidata/datasets/README.md": "reference/adapters.md",
    "hoidata/files/README.md": "reference/files.md",
}
LINK = re.compile(r"\]\(((?:\.\./)*)([\w./-]+\.md)(#[^)]*)?\)")


def on_files(files, config):
    """Add the pages to the files of the site."""
    for source, target in PAGES.items():
        files.append(File.generated(config, target, content=(ROOT / source).read_text(encoding="utf-8")))
    for target, text in reference.PAGES.items():
        files.append(File.generated(config, target, content=text()))
    return files


def on_page_markdown(markdown, page, config, files):
    """Rewrite links from a page in ``docs`` to a page elsewhere in the repository."""
    folder = posixpath.dirname(page.file.src_uri)

    def rewritten(match: re.Match) -> str:
        path = posixpath.normpath(posixpath.join("docs", folder, match[1] + match[2]))
        if path not in PAGES:
            return match[0]
        return f"]({os.path.relpath(PAGES[path], folder or '.')}{match[3] or ''})"

    return LINK.sub(rewritten, markdown)
