"""The ``hoidata`` command. Sub-commands import their modules when they run, so that ``--help`` is fast."""

import sys
from io import TextIOWrapper

import typer

from hoidata.errors import HoidataError, explain_machine_errors
from pipelines.commands import (
    adapters,
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
app.add_typer(synth.app, name="synth", help="Write the generated corpora.")
app.add_typer(adapters.app, name="adapters", help="List the dataset adapters, or check one.")
app.add_typer(raw.app, name="raw", help="Scan your raw files into a manifest, or verify them.")
app.add_typer(lineage.app, name="lineage")
for command in (
    init.init, adapters.convert, graph.repro, graph.up, graph.down, inspect.doctor, inspect.info, inspect.validate,
    raw.profile, settings.settings, share.share, evaluate.evaluate, evaluate.compare, evaluate.controls,
    evaluate.table, motions.generate, motions.animate, motions.stream, motions.hands, show.show, export.export,
):  # fmt: skip
    app.command()(command)


@app.callback()
def _check_digests_of_read_files() -> None:
    from hoidata.files.written import verify_with
    from pipelines.lineage.locks import written_digest

    verify_with(written_digest)


def main() -> None:
    """Run the command. Bad input and machine errors (such as a full disk) give one line on stderr and exit code 1."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # file names may have bytes that are not UTF-8
    try:
        with explain_machine_errors():
            app()
    except HoidataError as error:
        from rich.console import Console
        from rich.markup import escape

        Console(stderr=True).print(f"[bold red]hoidata:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
