"""Text in Markdown pages."""

import re
from typing import Any

_MARKUP = re.compile(r"[\\`*_\[\]|~$]")


def markdown_text(text: Any) -> str:
    """Text of a file as text in Markdown: on one line, and nothing in it is markup, HTML or the border of a table."""
    return _MARKUP.sub(r"\\\g<0>", " ".join(str(text).split())).replace("&", "&amp;").replace("<", "&lt;")
