"""Pages of the site that are made from the code when it is built (``site.py``)."""

import ast
import inspect
import io
import tokenize
from typing import Any

import yaml
from typer.main import get_command

from hoidata.settings import plain_config
from pipelines.cli import app
from pipelines.commands.settings import SECTIONS, settings_class


def commands() -> str:
    """The page of all commands with their arguments and options."""
    lines = ["# Commands\n", "`hoidata COMMAND --help` prints the same.\n"]
    for name, command in _leaf_commands("hoidata", get_command(app)):
        lines.append(f"## {name}\n\n{_one_line(command.help)}\n")
        items = [_parameter_item(parameter) for parameter in command.params if parameter.name != "help"]
        if items:
            lines += [*items, ""]
    return "\n".join(lines).rstrip() + "\n"


def _leaf_commands(name: str, command: Any) -> list[tuple[str, Any]]:
    children = getattr(command, "commands", None)
    if children is None:
        return [(name, command)]
    return [item for word, child in children.items() for item in _leaf_commands(f"{name} {word}", child)]


def _parameter_item(parameter: Any) -> str:
    flags = ", ".join([*parameter.opts, *parameter.secondary_opts]) if parameter.opts[0].startswith("-") else ""
    name = f"`{flags or parameter.metavar or parameter.name.upper()}`"
    empty = parameter.default is None or parameter.default in ("", [], ()) or callable(parameter.default)
    default = "" if empty or parameter.required else f" Default: `{parameter.default}`."
    return f"- {name}: {_one_line(getattr(parameter, 'help', ''))}{default}"


def _one_line(text: str | None) -> str:
    return " ".join((text or "").split())


def settings() -> str:
    """The page of the sections of params.yaml for the data stages, with defaults and the meaning of each key."""
    lines = ["# Settings\n"]
    lines.append("The sections of `params.yaml` for the data stages, with their defaults. Unknown keys are refused.")
    lines.append("`hoidata settings` prints the current values.\n")
    for section in SECTIONS:
        kind = settings_class(section)
        text = yaml.safe_dump({section: plain_config(kind())}, sort_keys=False, width=100)
        items = [f"- `{name}`: {_sentence(meaning)}" for name, meaning in field_comments(kind).items()]
        lines.append(f"## {section}\n\n{_paragraphs(kind.__doc__)}\n")
        lines += [*items, ""] if items else []
        lines.append(f"```yaml\n{text}```\n")
    lines.append("The settings of networks, presets and sizes are in `params.yaml` under `train`. Those of")
    lines.append("`sample.text2hoi` are in `SamplingConfig` of `models/text2hoi/sampler.py`.")
    lines.append("Reasons: [decisions](../decisions.md).\n")
    return "\n".join(lines)


def field_comments(kind: type) -> dict[str, str]:
    """The comment of each field of a class: on its line, as a string below it, or else on the lines above it."""
    source = inspect.getsource(kind)
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    meanings: dict[str, str] = {}
    code_end = definition.lineno
    for statement, following in zip(definition.body, [*definition.body[1:], None], strict=True):
        if isinstance(statement, ast.AnnAssign):
            end = statement.end_lineno or statement.lineno
            above = [comments[line] for line in range(code_end + 1, statement.lineno) if line in comments]
            below = following.value if isinstance(following, ast.Expr) else None
            meaning = comments.get(end, "")
            if not meaning and isinstance(below, ast.Constant) and isinstance(below.value, str):
                meaning = below.value
            if meaning := meaning or " ".join(above):
                meanings[ast.unparse(statement.target)] = _one_line(meaning)
        code_end = statement.end_lineno or statement.lineno
    return meanings


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."


def _paragraphs(text: str | None) -> str:
    blocks = (text or "").strip().split("\n\n")
    return "\n\n".join(" ".join(block.split()) for block in blocks)


PAGES = {"reference/commands.md": commands, "reference/settings.md": settings}
