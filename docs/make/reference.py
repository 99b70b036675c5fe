"""Pages of docs/reference that are printed from tables: python -m docs.make.reference writes them, a test compares."""

from pathlib import Path
from typing import Any

import yaml
from typer.main import get_command

from hoidata.settings import plain_config
from pipelines.cli import app
from pipelines.commands.settings import SECTIONS, settings_class

FOLDER = Path(__file__).parents[1] / "reference"
HEAD = "<!-- printed by docs/make/reference.py from the code's own tables -->\n\n"


def commands() -> str:
    """Every command with its arguments and options, as the program knows them."""
    lines = [f"{HEAD}# Commands\n", "`hoidata COMMAND --help` prints the same.\n"]
    for name, command in _walk("hoidata", get_command(app)):
        lines.append(f"## {name}\n\n{_one_line(command.help)}\n")
        rows = [_row(parameter) for parameter in command.params if parameter.name != "help"]
        if rows:
            lines += [*rows, ""]
    return "\n".join(lines).rstrip() + "\n"


def _walk(name: str, command: Any) -> list[tuple[str, Any]]:
    below = getattr(command, "commands", None)
    if below is None:
        return [(name, command)]
    return [item for word, child in below.items() for item in _walk(f"{name} {word}", child)]


def _row(parameter: Any) -> str:
    flags = ", ".join([*parameter.opts, *parameter.secondary_opts]) if parameter.opts[0].startswith("-") else ""
    shown = f"`{flags or parameter.metavar or parameter.name.upper()}`"
    empty = parameter.default is None or parameter.default in ("", [], ()) or callable(parameter.default)
    default = "" if empty or parameter.required else f" Default: `{parameter.default}`."
    return f"- {shown}: {_one_line(getattr(parameter, 'help', ''))}{default}"


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def settings() -> str:
    """The sections of the data stages with all defaults, and what their classes say of them."""
    lines = [
        f"{HEAD}# Settings\n",
        "Sections of `params.yaml` with the defaults of the library; what is written there takes",
    ]
    lines.append("their place, unknown names are refused. `hoidata settings` prints them as they are set now.\n")
    for section in SECTIONS:
        kind = settings_class(section)
        text = yaml.safe_dump({section: plain_config(kind())}, sort_keys=False, width=100)
        lines.append(f"## {section}\n\n{_paragraphs(kind.__doc__)}\n\n```yaml\n{text}```\n")
    lines.append(
        "Networks, presets and sizes stand in `params.yaml` itself, under `train`; what `sample.text2hoi` may say, in"
    )
    lines.append("`SamplingConfig` of `models/text2hoi/sampler.py`. Reasons: [decisions](../decisions.md).\n")
    return "\n".join(lines)


def _paragraphs(text: str | None) -> str:
    blocks = (text or "").strip().split("\n\n")
    return "\n\n".join(" ".join(block.split()) for block in blocks)


PAGES = {"commands.md": commands, "settings.md": settings}

if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in PAGES.items():
        (FOLDER / name).write_text(text())
