"""``hoidata doctor``, ``info`` and ``lineage``: what is here and where it comes from."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.tree import Tree

from pipelines.commands.project import enter_project

SHOWN_ROWS = 12


def doctor() -> None:
    """Say what is installed and which raw folders, hand, encoder and GPU were found; exit code 1 if one is broken."""
    enter_project()
    from pipelines.doctor import examine

    findings = examine()
    table = Table("part", "state", "found")
    colours = {"ok": "green", "absent": "yellow", "broken": "red"}
    for finding in findings:
        table.add_row(finding.part, f"[{colours[finding.state]}]{finding.state}[/]", escape(finding.found))
    Console().print(table)
    raise typer.Exit(1 if any(finding.state == "broken" for finding in findings) else 0)


def info(
    store: Annotated[Path, typer.Argument(help="A store of clips.", exists=True, file_okay=False, resolve_path=True)],
    everything: Annotated[bool, typer.Option("--all", help="List all objects, verbs and what was left out.")] = False,
) -> None:
    """Describe a store: clips by object and verb, conventions, licence, and what was left out and why."""
    from hoidata.store.store import open_store
    from pipelines.commands.store_facts import fact_rows, group_rows, left_out_rows
    from pipelines.stages.base import empty_reason

    if reason := empty_reason(store):
        typer.echo(f"{store}: empty, {reason}")
        return
    opened, console = open_store(store), Console()
    shown = None if everything else SHOWN_ROWS
    _print_rows(console, ("what", "value"), fact_rows(opened), None)
    for column in ("object", "verb"):
        _print_rows(console, (column, "clips", "frames"), group_rows(opened, column), shown)
    _print_rows(console, ("left out", "where", "expected", "got"), left_out_rows(opened), shown)


def _print_rows(console, heads: tuple[str, ...], rows: list[tuple[str, ...]], shown: int | None) -> None:
    """A table with at most ``shown`` rows; says how many more there are."""
    if not rows:
        return
    table = Table()
    for head in heads:
        table.add_column(head, justify="right" if head in ("clips", "frames") else "left", overflow="fold")
    for row in rows[:shown]:
        table.add_row(*map(escape, row))
    console.print(table)
    if shown is not None and len(rows) > shown:
        console.print(f"and {len(rows) - shown:,} more (--all lists them)")


def lineage(
    checkpoint: Annotated[Path, typer.Argument(help="A model.safetensors, or its folder.", resolve_path=True)],
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a tree.")] = False,
    clips: Annotated[bool, typer.Option("--clips", help="List the ids of the clips it was trained on.")] = False,
) -> None:
    """Print what a checkpoint was made from. Exit code 0 when all of it is still the same today, 1 when not."""
    project = enter_project()
    from pipelines.lineage.tree import lineage_tree, overall_status

    file = checkpoint / "model.safetensors" if checkpoint.is_dir() else checkpoint
    file = file.relative_to(project) if file.is_relative_to(project) else file
    tree, provenance = lineage_tree(Path(), file)
    if json:
        _print_json(tree, provenance)
    else:
        _print_tree(tree, provenance, clips)
    raise typer.Exit(0 if overall_status(tree) == "same" else 1)


def _print_json(tree, provenance: dict) -> None:
    import json as json_module

    from pipelines.lineage.tree import overall_status, tree_as_json

    kept = ("stage", "model", "config", "seed", "synthetic", "libraries", "clips", "params_digest", "code_digest")
    facts = {key: provenance[key] for key in kept if key in provenance}
    values = {"schema": "hoidata.lineage/1", "status": overall_status(tree), **facts, "tree": tree_as_json(tree)}
    typer.echo(json_module.dumps(values, indent=2, ensure_ascii=False))


def _print_tree(tree, provenance: dict, show_clips: bool) -> None:
    from pipelines.lineage.tree import overall_status

    console, top = Console(), Tree(_label(tree))
    for child in tree.children:
        _grow(top, child)
    branch = top.add("clips it was trained and judged on")
    known = provenance.get("clips", {})
    if isinstance(known, str):
        branch.add(f"clips seen: {known}")
    for split, ids in known.items() if isinstance(known, dict) else ():
        names = branch.add(f"{split}: {len(ids)}")
        for clip_id in ids if show_clips else ids[:3]:
            names.add(clip_id)
        if len(ids) > 3 and not show_clips:
            names.add(f"and {len(ids) - 3} more (--clips lists all)")
    console.print(top, soft_wrap=True)
    versions = ", ".join(f"{name} {version}" for name, version in provenance.get("libraries", {}).items())
    console.print(f"libraries: {versions}", soft_wrap=True, highlight=False)
    console.print(f"status: {overall_status(tree)}", highlight=False)


def _grow(parent, node) -> None:
    branch = parent.add(_label(node))
    for child in node.children:
        if node.kind != "code" or child.status != "same":
            _grow(branch, child)


def _label(node) -> str:
    colour = {"same": "green", "changed": "yellow", "missing": "red"}[node.status]
    detail = f" [dim]{escape(node.detail)}[/]" if node.detail else ""
    return f"{node.kind} [bold]{escape(node.name)}[/] [{colour}]{node.status}[/]{detail}"
