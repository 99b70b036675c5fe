"""``hoidata adapters`` and ``hoidata convert``: list, check and run dataset adapters without a project."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.project import chosen_hands, table_console
from pipelines.params import load_yaml

if TYPE_CHECKING:
    from hoidata.hands import HandPair

app = typer.Typer(no_args_is_help=True)
# The module with the list of verbs and objects, for datasets whose sentences come from such a list.
TEMPLATED = {"grab": "adapter", "h2o": "files", "arctic": "adapter"}
COLOURS = {"pass": "green", "warn": "yellow", "fail": "bold red", "skip": "dim"}
Name = Annotated[str, typer.Argument(help="Name of an adapter, as `hoidata adapters list` shows it.")]
Root = Annotated[Path, typer.Option(help="Folder with the raw files.", exists=True, file_okay=False, resolve_path=True)]
Sequences = Annotated[int, typer.Option(help="Number of sequences to load, evenly spread.", min=1)]
HAND = "Hand model: embedded, or the folder of the MANO files. Default: "
Hand = Annotated[str, typer.Option(help=f"{HAND}the registered MANO files, else embedded.")]
ConvertHand = Annotated[str, typer.Option(help=f"{HAND}HOIDATA_MANO, else registered files.")]
Setting = Annotated[list[str] | None, typer.Option(help="A setting of the adapter, KEY=VALUE; can be repeated.")]
Strict = Annotated[bool, typer.Option("--strict", help="Count warnings as failures.")]
Out = Annotated[Path, typer.Option(help="Folder of the new store of clips; must not exist.", resolve_path=True)]
Jobs = Annotated[int, typer.Option(help="Number of worker processes; 0 means one per core.", min=0)]
Synthetic = Annotated[bool, typer.Option("--synthetic", help="Mark the store as synthetic, for generated files.")]


@app.command("list")
def list_adapters() -> None:
    """List all adapters with dataset version, licence, origin, and settings with their defaults."""
    from hoidata.datasets.registry import registered_adapters

    heads = ("name", "version", "licence", "may be shared", "from", Column("settings", overflow="fold"))
    table = Table(*heads, show_lines=True)
    for entry in registered_adapters():
        if entry.adapter is None:
            table.add_row(entry.name, "", f"[bold red]{escape(entry.problem)}", "", escape(entry.origin), "")
            continue
        facts, settings = entry.adapter, "\n".join(f"{key}={value!r}" for key, value in entry.settings.items())
        shared = "yes" if facts.may_be_shared else "no"
        table.add_row(*map(escape, (entry.name, facts.version, facts.licence, shared, entry.origin, settings)))
    table_console().print(table)


@app.command()
def sentences(
    names: Annotated[
        list[str] | None, typer.Argument(help="Datasets: grab, h2o or arctic. Default: all three.")
    ] = None,
    hand: Annotated[Literal["left", "right", "both"], typer.Option(help="Hand that the sentences name.")] = "right",
) -> None:
    """Print the four sentences that the stage annotate writes for each verb and object of GRAB, H2O and ARCTIC."""
    from importlib import import_module

    from hoidata.annotation.sentences import english_sentences

    for name in names or TEMPLATED:
        if name not in TEMPLATED:
            raise BadInput("hoidata adapters sentences", " or ".join(TEMPLATED), name, "choose one of them")
        pairs = import_module(f"hoidata.datasets.{name}.{TEMPLATED[name]}").PAIRS
        typer.echo(f"{name}: {len(pairs)} pairs of verb and object")
        for verb, noun in pairs:
            typer.echo(f"  {verb}, {noun}: {' '.join(english_sentences(verb, noun, hand))}")


@app.command()
def check(
    name: Name, root: Root, sequences: Sequences = 4, hand: Hand = "", setting: Setting = None, strict: Strict = False
) -> None:
    """Run the conformance checks of an adapter on raw files. The exit code is 1 if a check fails.

    Files below ROOT are not changed; altered copies are in a temporary folder.
    """
    from hoidata.conformance.check import check_adapter
    from hoidata.datasets.registry import get_adapter

    adapter = get_adapter(name, **read_settings(setting or []))
    hands, note = _hands(hand, adapter.needs_mano and not root.with_suffix(".recipe").is_file())
    with Console(stderr=True).status(f"loading up to {sequences} sequences of {name}, each several times"):
        findings = check_adapter(adapter, root, hands, sequences)
    bad = {"fail", "warn"} if strict else {"fail"}
    table = Table("", "rule", "result", title=f"adapter {name}", caption=note)
    for item in findings:
        table.add_row(f"[{COLOURS[item.outcome]}]{item.outcome}", escape(item.rule), escape(item.detail))
    counts = Counter(item.outcome for item in findings)
    console = table_console()
    console.print(table)
    console.print(", ".join(f"{counts[outcome]} {outcome}" for outcome in COLOURS if counts[outcome]))
    raise typer.Exit(any(item.outcome in bad for item in findings))


def _hands(choice: str, needs_mano: bool) -> "tuple[HandPair, str]":
    """The hand model to check with, and a note for the table."""
    from hoidata.store.info import EMBEDDED_HAND_ERROR

    hands, note = chosen_hands(choice), ""
    if needs_mano and hands.name == "embedded":
        note = f"; with files made for MANO, ignore warnings about touch: {EMBEDDED_HAND_ERROR}"
    return hands, f"hand: {hands.name}{note}"


def convert(
    name: Name,
    root: Root,
    out: Out,
    hand: ConvertHand = "",
    setting: Setting = None,
    jobs: Jobs = 0,
    synthetic: Synthetic = False,
) -> None:
    """Convert all sequences of a raw folder to a store of clips, and list those that cannot be used.

    A killed run resumes. Corpora of `hoidata synth` are recognised and marked as synthetic.
    """
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets.registry import get_adapter
    from pipelines.stages import base

    if out.exists():
        remedy = "choose another name, or remove it"
        raise BadInput(out, "a path that does not exist", "an existing file or folder", remedy)
    adapter = get_adapter(name, **read_settings(setting or []))
    generated = synthetic or root.with_suffix(".recipe").is_file()
    if adapter.needs_mano and not hand and not generated and base.registered_root(base.HAND) is None:
        without_mano = getattr(adapter, "without_mano", "")
        raise MissingResource(
            f"{name} has MANO parameters; name the folder of MANO_RIGHT.pkl and MANO_LEFT.pkl: --hand FOLDER "
            "(register at https://mano.is.tue.mpg.de)" + (f", or use --setting {without_mano}" if without_mano else "")
        )
    hands = chosen_hands(hand or ("embedded" if generated else ""))
    summary = convert_dataset(adapter, root, hands, out, jobs or base.jobs(), synthetic=generated)
    typer.echo(out)
    raise typer.Exit(0 if summary.clips else 1)


def read_settings(pairs: list[str]) -> dict[str, Any]:
    """Settings from texts such as ``margin_frames=5``, with values parsed as YAML."""
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
