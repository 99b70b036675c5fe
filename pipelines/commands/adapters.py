"""``hoidata adapters`` and ``hoidata convert``: readers of datasets, listed, checked and run without a project."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.project import chosen_hands
from pipelines.params import load_yaml

if TYPE_CHECKING:
    from hoidata.hands import HandPair

app = typer.Typer(no_args_is_help=True)
# Datasets whose sentences come from a list of verbs and objects, and the module with that list.
TEMPLATED = {"grab": "words", "h2o": "files", "arctic": "files"}
COLOURS = {"pass": "green", "warn": "yellow", "fail": "bold red", "skip": "dim"}
Name = Annotated[str, typer.Argument(help="A name that `hoidata adapters list` shows.")]
Root = Annotated[Path, typer.Option(help="A raw folder it can read.", exists=True, file_okay=False, resolve_path=True)]
Sequences = Annotated[int, typer.Option(help="How many sequences to load, spread over those there are.", min=1)]
Hand = Annotated[
    str, typer.Option(help="embedded, or the folder of the MANO files; by default those registered, if any.")
]
Setting = Annotated[list[str] | None, typer.Option(help="One setting of the adapter, key=value; may be repeated.")]
Strict = Annotated[bool, typer.Option("--strict", help="Warnings fail too.")]
Out = Annotated[Path, typer.Option(help="The store to write; it must not be there yet.", resolve_path=True)]
ConvertHand = Annotated[str, typer.Option(help="embedded, or the folder of the MANO files; by default HOIDATA_MANO.")]
Jobs = Annotated[int, typer.Option(help="Worker processes; 0: one per core.", min=0)]
Synthetic = Annotated[bool, typer.Option("--synthetic", help="The files were generated, and the store is to say so.")]


@app.command("list")
def list_adapters() -> None:
    """All known adapters: dataset version, licence, where they come from, settings with their defaults."""
    from hoidata.datasets.registry import registered_adapters

    table = Table("name", "version", "licence", "may be shared", "from", show_lines=True)
    table.add_column("settings", overflow="fold")
    for row in registered_adapters():
        if row.adapter is None:
            table.add_row(row.name, "", f"[bold red]{escape(row.problem)}", "", escape(row.origin), "")
            continue
        facts, settings = row.adapter, "\n".join(f"{key}={value!r}" for key, value in row.settings.items())
        shared = "yes" if facts.may_be_shared else "no"
        table.add_row(*map(escape, (row.name, facts.version, facts.licence, shared, row.origin, settings)))
    Console().print(table)


@app.command()
def sentences(
    names: Annotated[list[str] | None, typer.Argument(help="grab, h2o or arctic; all three by default.")] = None,
    hand: Annotated[Literal["left", "right", "both"], typer.Option(help="The hand that the sentences name.")] = "right",
) -> None:
    """Print the four sentences of every verb and object of GRAB, H2O and ARCTIC, as the stage annotate writes them."""
    from importlib import import_module

    from hoidata.annotation.sentences import four_sentences

    for name in names or TEMPLATED:
        if name not in TEMPLATED:
            raise BadInput("hoidata adapters sentences", " or ".join(TEMPLATED), name, "choose one of them")
        pairs = import_module(f"hoidata.datasets.{name}.{TEMPLATED[name]}").PAIRS
        typer.echo(f"{name}: {len(pairs)} pairs of verb and object")
        for verb, words in pairs:
            typer.echo(f"  {verb}, {words}: {' '.join(four_sentences(verb, words, hand))}")


@app.command()
def check(
    name: Name,
    root: Root,
    sequences: Sequences = 4,
    hand: Hand = "",
    setting: Setting = None,
    strict: Strict = False,
) -> None:
    """Try every rule of an adapter on real input. Exit code 1 when one fails.

    Nothing below ROOT is written to; altered copies are hard links in a temporary folder.
    """
    from hoidata.conformance.check import check_adapter
    from hoidata.datasets.registry import get_adapter

    adapter = get_adapter(name, **read_settings(setting or []))
    hands, note = _hands(hand, adapter.needs_mano and not root.with_suffix(".recipe").is_file())
    with Console(stderr=True).status(f"loading up to {sequences} sequences of {name}, each several times"):
        findings = check_adapter(adapter, root, hands, sequences)
    bad = {"fail", "warn"} if strict else {"fail"}
    failed = sum(item.outcome in bad for item in findings)
    _print(name, findings, note)
    raise typer.Exit(1 if failed else 0)


def convert(
    name: Name,
    root: Root,
    out: Out,
    hand: ConvertHand = "",
    setting: Setting = None,
    jobs: Jobs = 0,
    synthetic: Synthetic = False,
) -> None:
    """Convert every sequence of a raw folder; what cannot be used is listed with its reason, in the store too.

    A killed run goes on where it was. Corpora made by `hoidata synth` are known as such.
    """
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets.registry import get_adapter
    from pipelines.stages.base import HAND, own_root
    from pipelines.stages.base import jobs as cores

    if out.exists():
        raise BadInput(out, "a store that is not there yet", "something else", "choose another name, or remove it")
    adapter = get_adapter(name, **read_settings(setting or []))
    generated = synthetic or root.with_suffix(".recipe").is_file()
    if adapter.needs_mano and not hand and not generated and own_root(HAND) is None:
        without_mano = getattr(adapter, "without_mano", "")
        raise MissingResource(
            f"{name} holds MANO parameters; say where MANO_RIGHT.pkl and MANO_LEFT.pkl are: --hand FOLDER "
            "(register at https://mano.is.tue.mpg.de)" + (f", or give --setting {without_mano}" if without_mano else "")
        )
    hands = chosen_hands(hand or ("embedded" if generated else ""))
    found = convert_dataset(adapter, root, hands, out, jobs or cores(), synthetic=generated)
    typer.echo(out)
    raise typer.Exit(0 if found.clips else 1)


def read_settings(pairs: list[str]) -> dict[str, Any]:
    """``margin_frames=5`` as a number, other values as YAML reads them."""
    settings = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise BadInput("--setting", "key=value", pair, "correct it")
        try:
            settings[key] = load_yaml(value.encode())
        except (ValueError, RecursionError) as error:
            raise BadInput(f"--setting {key}", "a value as in params.yaml", str(error)[:300], "correct it") from error
    return settings


def _hands(choice: str, needs_mano: bool) -> "tuple[HandPair, str]":
    """The hand to check with, and what to say about it."""
    from hoidata.store.info import STAND_IN_ERROR

    hands = chosen_hands(choice)
    note = f"hand: {hands.name}"
    if needs_mano and hands.name == "embedded":
        note += f"; on files made with MANO warnings about touch mean nothing: {STAND_IN_ERROR}"
    return hands, note


def _print(name: str, findings, note: str) -> None:
    table = Table("", "rule", "seen", title=f"adapter {name}", caption=note)
    for item in findings:
        table.add_row(f"[{COLOURS[item.outcome]}]{item.outcome}", escape(item.rule), escape(item.detail))
    counts = Counter(item.outcome for item in findings)
    console = Console()
    console.print(table)
    console.print(", ".join(f"{counts[outcome]} {outcome}" for outcome in COLOURS if counts[outcome]))
