"""``hoidata lineage``: what a file was made from, and ``diff``, ``uses``, ``check`` and ``rerun``.

``hoidata lineage TARGET`` needs no word before the target: only those four, as the first word, mean something else, and
a file of such a name is ``./diff``.
"""

import json as json_module
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
COLOURS = {"same": "green", "recorded": "cyan", "uncommitted": "yellow", "changed": "yellow"}
FACTS = ("stage", "model", "config", "seed", "synthetic", "libraries", "clips", "params_digest", "code_digest")


class _OfUnlessNamed(TyperGroup):
    """Without one of its words the group means ``of``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ("--help", "-h"):
            args = [SHOW, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_OfUnlessNamed,
    no_args_is_help=True,
    help="What a file was made from: hoidata lineage TARGET [--json|--mermaid|--prov|--page FILE|--raw]; "
    "and what two differ in, what saw some data, whether all is whole, whether it can be made again.",
)


@app.command(SHOW)
def of(
    target: Annotated[str, typer.Argument(help="A checkpoint, store, metric file or motion: its path, or a digest.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a tree.")] = False,
    mermaid: Annotated[bool, typer.Option("--mermaid", help="Print a Mermaid flowchart.")] = False,
    prov: Annotated[bool, typer.Option("--prov", help="Print PROV-JSON.")] = False,
    page: Annotated[Path | None, typer.Option(help="Write a page to click through.", resolve_path=True)] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="Every raw file and frame behind it, with digest, licence.")
    ] = False,
    clips: Annotated[bool, typer.Option("--clips", help="List the ids of the clips it was trained on.")] = False,
) -> None:
    """What a file was made from (no need to type ``of``). Exit code 0 when all is the same or only recorded, else 1."""
    root, here = _project()
    from pipelines.lineage import formats
    from pipelines.lineage.raw import raw_sources
    from pipelines.lineage.targets import find_target
    from pipelines.lineage.tree import overall_status, target_tree

    if sum((json, mermaid, prov)) > 1:
        raise BadInput("hoidata lineage", "one form", "several", "choose --json, --mermaid or --prov")
    found = find_target(root, target, here)
    tree, sources = target_tree(root, found), []
    if raw or page:
        sources = raw_sources(root, found.record) if found.kind != "motion" else _raw_of_motion(root, found.record)
    if page:
        formats.write_lineage_page(page, tree, found.record, sources)
    if mermaid:
        typer.echo(formats.mermaid(tree, found.record), nl=False)
    elif json or prov:
        values = formats.prov(tree, found.record) if prov else _json(tree, found.record, sources if raw else None)
        typer.echo(json_module.dumps(values, indent=2, ensure_ascii=False))
    elif raw:
        _print_raw(sources)
    else:
        _print_tree(tree, found.record, clips)
    raise typer.Exit(0 if overall_status(tree) in ("same", "recorded") else 1)


@app.command()
def diff(
    first: Annotated[str, typer.Argument(help="A checkpoint, store or metric file: its path, or a digest.")],
    second: Annotated[str, typer.Argument(help="Another one.")],
) -> None:
    """What made two differ: params, code, data, raw files, seed, libraries. Exit code 0 when nothing did, 1 else."""
    root, here = _project()
    from pipelines.lineage.diff import differences
    from pipelines.lineage.targets import find_target

    targets = [find_target(root, words, here) for words in (first, second)]
    if any(target.kind == "motion" for target in targets):
        raise BadInput(
            "hoidata lineage diff", "two checkpoints, stores or metric files", "a motion", "name its networks"
        )
    if targets[0].is_of_lock != targets[1].is_of_lock:
        raise BadInput("hoidata lineage diff", "two of a kind", "a checkpoint and something else", "name two of a kind")
    found = differences(root, *(target.record for target in targets))
    for line in found or ["nothing that is recorded differs"]:
        typer.echo(line)
    raise typer.Exit(1 if found else 0)


@app.command()
def uses(
    what: Annotated[str, typer.Argument(help="A raw file's path, a subject, an object or a clip.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Every store, table, checkpoint, sample and metric that saw it: what must go when data is withdrawn."""
    root = enter_project()
    from pipelines.lineage.uses import uses as find_uses

    found = find_uses(root, what)
    if json:
        typer.echo(json_module.dumps([vars(use) for use in found], indent=2, ensure_ascii=False))
        return
    for use in found:
        typer.echo(f"{use.kind} {use.name}: {use.why}")


@app.command()
def check(
    target: Annotated[str, typer.Argument(help="Only what is behind this; everything when left out.")] = "",
    against: Annotated[
        Path | None, typer.Option(help="A table of a whole run, such as docs/digests/embedded.json.", resolve_path=True)
    ] = None,
    write: Annotated[Path | None, typer.Option(help="Write such a table of what is here.", resolve_path=True)] = None,
) -> None:
    """Hash everything again: outputs, seals of checkpoints, raw files. Exit code 0 when all is as it was written.

    With --against: whether the data and networks here are those that somebody else's run made.
    """
    here, root = Path.cwd(), enter_project()
    from pipelines.lineage.check import check as check_all
    from pipelines.lineage.check import compare_made, write_made
    from pipelines.lineage.targets import find_target
    from pipelines.params import read_params

    if against:
        nodes = compare_made(root, against)
    else:
        nodes = check_all(root, find_target(root, target, here) if target else None)
    other = [node for node in nodes if node.status != "same"]
    wrong = [node for node in other if node.status != "recorded"]
    console = Console()
    for node in other:
        console.print(_label(node), soft_wrap=True)
    excused = f", {len(other) - len(wrong)} of another machine" * (len(other) > len(wrong))
    console.print(f"{len(nodes)} looked at, {len(wrong)} not as they were written{excused}", highlight=False)
    if write and not wrong:
        write_made(root, read_params(root)["profile"], write)
    raise typer.Exit(1 if wrong else 0)


@app.command()
def rerun(
    target: Annotated[str, typer.Argument(help="A checkpoint of this project.")],
    commit: Annotated[str, typer.Option(help="Whose code and settings to train with.")] = "HEAD",
) -> None:
    """Train a checkpoint again in a clean clone and compare its weights. Exit code 0 when they are the same bytes."""
    here, root = Path.cwd(), enter_project()
    from pipelines.lineage.rerun import rerun as train_again
    from pipelines.lineage.targets import find_target

    before, after = train_again(root, find_target(root, target, here), commit)
    same = before == after
    typer.echo(f"payload sha256 {before}\ntrained again  {after}\n{'same' if same else 'other weights'}")
    raise typer.Exit(0 if same else 1)


def _project() -> tuple[Path | None, Path]:
    """The project, entered, or None outside of any; and where the command was typed."""
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
    values = {"schema": SCHEMA, "status": overall_status(tree), **facts, "tree": tree_as_json(tree)}
    raw = {source.store: source.as_json() for source in sources or ()}
    return values | ({"raw": raw} if sources is not None else {})


def _print_raw(sources: list) -> None:
    """One line per raw file, then one per clip with its frames in the source."""
    for source in sources:
        typer.echo(f"{source.store}: {len(source.digests)} files, {len(source.clips)} clips, licence {source.licence}")
        for path, digest in source.digests.items():
            typer.echo(f"  {digest}  {path}")
        for clip in source.clips:
            typer.echo(f"  {clip.clip_id}  frames {clip.frames[0]}-{clip.frames[1]}  {' '.join(clip.files)}")
    if not sources:
        typer.echo("no raw files are recorded, and there is no store here to ask")


def _print_tree(tree, record: dict, show_clips: bool) -> None:
    from pipelines.lineage.tree import overall_status

    console, top = Console(), Tree(_label(tree))
    for child in tree.children:
        _grow(top, child)
    clips = {} if tree.kind == "motion" else record.get("clips", {})
    branch = top.add("clips it was trained and judged on") if clips else top
    for split, ids in clips.items():
        names = branch.add(f"{split}: {len(ids)}")
        for clip_id in ids if show_clips else ids[:3]:
            names.add(escape(clip_id))
        if len(ids) > 3 and not show_clips:
            names.add(f"and {len(ids) - 3} more (--clips lists all)")
    console.print(top, soft_wrap=True)
    if libraries := record.get("libraries"):
        versions = ", ".join(f"{name} {version}" for name, version in libraries.items())
        console.print(f"libraries: {escape(versions)}", soft_wrap=True, highlight=False)
    console.print(f"status: {overall_status(tree)}", highlight=False)


def _grow(parent, node) -> None:
    """The node's children; of code only the files that are not as recorded."""
    branch = parent.add(_label(node))
    for child in node.children:
        if node.kind != "code" or child.status not in ("same", "recorded"):
            _grow(branch, child)


def _label(node) -> str:
    colour = COLOURS.get(node.status, "red")
    algorithm, _, digest = node.digest.partition(" ")
    short = f"{algorithm} {digest[:12]}" if digest and node.kind != "code" else ""
    detail = "; ".join(filter(None, (node.detail, short)))
    return f"{node.kind} [bold]{escape(node.name)}[/] [{colour}]{node.status}[/]" + (
        f" [dim]{escape(detail)}[/]" if detail else ""
    )
