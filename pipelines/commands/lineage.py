"""``hoidata lineage``: the inputs of a file; ``diff``, ``uses``, ``check`` and ``rerun``.

``hoidata lineage TARGET`` is short for ``hoidata lineage of TARGET``. A file named like a sub-command is ``./diff``.
"""

import json as json_module
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.tree import Tree
from typer.core import TyperGroup

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.project import enter_project

SCHEMA = "hoidata.lineage/2"
SHOW = "of"
UNCUT = 100_000  # characters in a line of a file or pipe
COLOURS = {"same": "green", "recorded": "cyan", "uncommitted": "yellow", "changed": "yellow"}
FACTS = ("stage", "model", "config", "seed", "synthetic", "libraries", "clips", "params_digest", "code_digest")


class _DefaultsToOf(TyperGroup):
    """A command group that runs ``of`` if the first argument is not a sub-command."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ("--help", "-h"):
            args = [SHOW, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_DefaultsToOf,
    no_args_is_help=True,
    help="Show the inputs of a file: hoidata lineage TARGET [--json|--mermaid|--prov|--page FILE|--raw]. "
    "Compare two files, list the uses of some data, verify all digests, or train a checkpoint again.",
)


@app.command(SHOW)
def of(
    target: Annotated[
        str, typer.Argument(help="A checkpoint, store, metric file or generated motion: its path, or its digest.")
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a tree.")] = False,
    mermaid: Annotated[bool, typer.Option("--mermaid", help="Print a Mermaid flowchart.")] = False,
    prov: Annotated[bool, typer.Option("--prov", help="Print PROV-JSON.")] = False,
    page: Annotated[Path | None, typer.Option(help="Write an HTML page to this file.", resolve_path=True)] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="List the raw files and frames behind it, with digests and licences.")
    ] = False,
) -> None:
    """Show all inputs of a file and whether they have changed; ``of`` can be omitted.

    The exit code is 0 if all inputs are unchanged or cannot be compared, else 1.
    """
    root, here = _project()
    from pipelines.lineage import formats
    from pipelines.lineage.raw import raw_sources
    from pipelines.lineage.targets import find_target
    from pipelines.lineage.tree import overall_status, target_tree

    if sum((json, mermaid, prov)) > 1:
        raise BadInput("hoidata lineage", "one format", "several", "choose --json, --mermaid or --prov")
    file = find_target(root, target, here)
    record, tree, sources = file.record, target_tree(root, file), []
    if raw or page:
        sources = raw_sources(root, record) if file.kind != "motion" else _raw_of_motion(root, record)
    if page:
        formats.write_lineage_page(page, tree, record, sources)
    if mermaid:
        typer.echo(formats.mermaid(tree, record), nl=False)
    elif json or prov:
        values = formats.prov(tree, record) if prov else _json(tree, record, sources if raw else None)
        typer.echo(json_module.dumps(values, indent=2, ensure_ascii=False))
    elif raw:
        _print_raw(sources)
    else:
        _print_tree(tree, record)
    raise typer.Exit(0 if overall_status(tree) in ("same", "recorded") else 1)


@app.command()
def diff(
    first: Annotated[str, typer.Argument(help="A checkpoint, store or metric file: its path, or its digest.")],
    second: Annotated[str, typer.Argument(help="The file to compare it with: its path, or its digest.")],
) -> None:
    """List the causes of a difference: params, code, data, raw files, seed, libraries.

    The exit code is 0 if nothing differs, else 1.
    """
    root, here = _project()
    from pipelines.lineage.diff import differences
    from pipelines.lineage.targets import find_target

    targets = [find_target(root, name, here) for name in (first, second)]
    command = "hoidata lineage diff"
    if any(target.kind == "motion" for target in targets):
        raise BadInput(command, "two checkpoints, stores or metric files", "a motion", "name its checkpoints")
    if targets[0].is_of_lock != targets[1].is_of_lock:
        raise BadInput(command, "two files of one kind", "a checkpoint and another file", "name two of one kind")
    causes = differences(root, *(target.record for target in targets))
    for line in causes or ["no recorded cause differs"]:
        typer.echo(line)
    raise typer.Exit(1 if causes else 0)


@app.command()
def uses(
    source: Annotated[
        str, typer.Argument(metavar="WHAT", help="The path of a raw file, a subject, an object, or a clip id.")
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List all outputs that use some data, and must be deleted if it is withdrawn.

    Outputs are stores, tables, checkpoints, samples and metrics.
    """
    root = enter_project()
    from pipelines.lineage.uses import uses as find_uses

    outputs = find_uses(root, source)
    lines = "\n".join(f"{use.kind} {use.name}: {use.why}" for use in outputs)
    typer.echo(json_module.dumps([vars(use) for use in outputs], indent=2, ensure_ascii=False) if json else lines)


@app.command()
def check(
    target: Annotated[str, typer.Argument(help="Check only this file and its inputs. Default: all outputs.")] = "",
    against: Annotated[
        Path | None,
        typer.Option(help="Compare with this digest table, such as docs/digests/embedded.json.", resolve_path=True),
    ] = None,
    write: Annotated[
        Path | None, typer.Option(help="Write a digest table of the profile's outputs to this file.", resolve_path=True)
    ] = None,
) -> None:
    """Hash outputs, checkpoints and raw files again, and report those that have changed since they were written.

    With --against, compare data and networks with those of another machine's run. The exit code is 0 if all are
    unchanged, else 1.
    """
    if target and against:
        raise BadInput("--against", "all outputs of the project", f"with {target}", "omit one of them")
    here, root = Path.cwd(), enter_project()
    from pipelines.lineage.check import check as check_all
    from pipelines.lineage.check import compare_made, write_made
    from pipelines.lineage.targets import find_target
    from pipelines.params import read_params

    chosen = find_target(root, target, here) if target else None
    nodes = compare_made(root, against) if against else check_all(root, chosen)
    deviating = [node for node in nodes if node.status != "same"]
    failed = [node for node in deviating if node.status != "recorded"]
    console = Console()
    for node in deviating:
        console.print(_label(node), soft_wrap=True)
    excused = f", {len(deviating) - len(failed)} from another machine" * (len(deviating) > len(failed))
    console.print(f"{len(nodes)} checked, {len(failed)} not as written{excused}", highlight=False)
    if write and not failed:
        write_made(root, read_params(root)["profile"], write)
    raise typer.Exit(1 if failed else 0)


@app.command()
def rerun(
    target: Annotated[str, typer.Argument(help="A checkpoint of this project.")],
    commit: Annotated[str, typer.Option(help="Git commit whose code and settings to train with.")] = "HEAD",
) -> None:
    """Train a checkpoint again in a clean clone and compare the weights.

    The exit code is 0 if they have the same bytes, else 1.
    """
    here, root = Path.cwd(), enter_project()
    from pipelines.lineage.rerun import rerun as train_again
    from pipelines.lineage.targets import find_target

    before, after = train_again(root, find_target(root, target, here), commit)
    same = before == after
    typer.echo(f"payload sha256 {before}\ntrained again  {after}\n{'same weights' if same else 'different weights'}")
    raise typer.Exit(0 if same else 1)


def _project() -> tuple[Path | None, Path]:
    """The project folder after changing into it (None outside of a project), and the folder before that."""
    here = Path.cwd()
    try:
        return enter_project(), here
    except MissingResource:
        return None, here


def _raw_of_motion(root: Path | None, checkpoints: dict[str, str]) -> list:
    from pipelines.lineage.raw import raw_sources
    from pipelines.lineage.targets import find_target

    if root is None:
        return []
    records = (find_target(root, name, root).record for name in checkpoints if (root / name).is_file())
    return list({source.store: source for record in records for source in raw_sources(root, record)}.values())


def _json(tree, record: dict, sources: list | None) -> dict[str, Any]:
    from pipelines.lineage.tree import overall_status, tree_as_json

    facts = {key: record[key] for key in FACTS if key in record}
    raw = {} if sources is None else {"raw": {source.store: source.as_json() for source in sources}}
    return {"schema": SCHEMA, "status": overall_status(tree), **facts, "tree": tree_as_json(tree), **raw}


def _print_raw(sources: list) -> None:
    """Print a line per raw file, then a line per clip with its frames in the source."""
    for source in sources:
        typer.echo(f"{source.store}: {len(source.digests)} files, {len(source.clips)} clips, licence {source.licence}")
        for path, digest in source.digests.items():
            typer.echo(f"  {digest}  {path}")
        for clip in source.clips:
            typer.echo(f"  {clip.clip_id}  frames {clip.frames[0]}-{clip.frames[1]}  {' '.join(clip.files)}")
    if not sources:
        typer.echo("no raw files are recorded, and the store is not here")


def _print_tree(tree, record: dict) -> None:
    from pipelines.lineage.tree import overall_status

    is_terminal = sys.stdout.isatty()
    # A tree cuts lines at the width; a terminal wraps them instead.
    console, top = Console(width=None if is_terminal else UNCUT), Tree(_label(tree))
    for child in tree.children:
        _add_branch(top, child)
    clips = {} if tree.kind == "motion" else record.get("clips", {})
    branch = top.add("training and validation clips") if clips else top
    for split, ids in clips.items():
        names = branch.add(f"{split}: {len(ids)}")
        for clip_id in ids[:3]:
            names.add(escape(clip_id))
        if len(ids) > 3:
            names.add(f"and {len(ids) - 3} more (--json lists all)")
    console.print(top, soft_wrap=not is_terminal)
    if libraries := record.get("libraries"):
        versions = ", ".join(f"{name} {version}" for name, version in libraries.items())
        console.print(f"libraries: {escape(versions)}", soft_wrap=True, highlight=False)
    console.print(f"status: {overall_status(tree)}", highlight=False)


def _add_branch(parent, node) -> None:
    """Add a node with its children; of code only the files that have changed."""
    branch = parent.add(_label(node))
    for child in node.children:
        if node.kind != "code" or child.status not in ("same", "recorded"):
            _add_branch(branch, child)


def _label(node) -> str:
    colour = COLOURS.get(node.status, "red")
    algorithm, _, digest = node.digest.partition(" ")
    short = f"{algorithm} {digest[:12]}" if digest and node.kind != "code" else ""
    detail = "; ".join(filter(None, (node.detail, short)))
    label = f"{node.kind} [bold]{escape(node.name)}[/] [{colour}]{node.status}[/]"
    return f"{label} [dim]{escape(detail)}[/]" if detail else label
