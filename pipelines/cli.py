"""The ``hoidata`` command. Every sub-command imports what it needs when it runs, so that ``--help`` is quick."""

import sys
from io import TextIOWrapper
from pathlib import Path

import typer

from hoidata.errors import HoidataError, told_in_words
from pipelines.commands import (
    adapters,
    compare,
    evaluate,
    export,
    graph,
    init,
    inspect,
    lineage,
    motions,
    raw,
    settings,
    share,
    show,
    synth,
)

app = typer.Typer(
    name="hoidata",
    help="Data and models for text-guided 3D hand-object interaction.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(synth.app, name="synth", help="The corpora made here: write them, check their physics.")
app.add_typer(adapters.app, name="adapters", help="Readers of datasets: list them, check that one keeps the rules.")
app.add_typer(raw.app, name="raw", help="Your own raw files: scan them into a manifest, verify them.")
app.add_typer(lineage.app, name="lineage")
app.command("init")(init.init)
app.command("convert")(adapters.convert)
app.command("repro")(graph.repro)
app.command("up")(graph.up)
app.command("down")(graph.down)
app.command("doctor")(inspect.doctor)
app.command("info")(inspect.info)
app.command("validate")(inspect.validate)
app.command("profile")(raw.profile)
app.command("settings")(settings.settings)
app.command("share")(share.share)
app.command("evaluate")(evaluate.evaluate)
app.command("compare")(compare.compare)
app.command("controls")(evaluate.controls)
app.command("table")(evaluate.table)
app.command("generate")(motions.generate)
app.command("animate")(motions.animate)
app.command("hands")(motions.hands)
app.command("show")(show.show)
app.command("export")(export.export)


@app.callback()
def _check_what_is_read() -> None:
    from hoidata.files.written import verify_with

    verify_with(_written_digest)


def main() -> None:
    """Run the command. Exit code 1 and one line on stderr when something is wrong with what it was given, or with the
    machine (a full disk, a folder that cannot be written)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a file name need not be UTF-8
    try:
        with told_in_words():
            app()
    except HoidataError as error:
        from rich.console import Console
        from rich.markup import escape

        Console(stderr=True).print(f"[bold red]hoidata:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)


def _written_digest(path: Path) -> str | None:
    from pipelines.lineage.locks import written_digest

    return written_digest(path)


if __name__ == "__main__":
    main()
