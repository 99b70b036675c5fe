"""The ``hoidata`` command. Every sub-command imports what it needs when it runs, so that ``--help`` is quick."""

import sys

import typer

from hoidata.errors import HoidataError
from pipelines.commands import (
    adapters,
    animate,
    controls,
    corpus,
    evaluate,
    generate,
    graph,
    hands,
    import_checkpoint,
    inspect,
    lineage,
    raw,
    settings,
    share,
    show,
    store,
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
app.command("repro")(graph.repro)
app.command("up")(graph.up)
app.command("down")(graph.down)
app.command("doctor")(inspect.doctor)
app.command("info")(inspect.info)
app.command("validate")(store.validate)
app.command("migrate")(store.migrate)
app.command("profile")(raw.profile)
app.command("settings")(settings.settings)
app.command("share")(share.share)
app.command("corpus")(corpus.corpus)
app.command("evaluate")(evaluate.evaluate)
app.command("controls")(controls.controls)
app.command("table")(evaluate.table)
app.command("import-checkpoint")(import_checkpoint.import_checkpoint)
app.command("generate")(generate.generate)
app.command("animate")(animate.animate)
app.command("hands")(hands.hands)
app.command("show")(show.show)


def main() -> None:
    """Run the command. Exit code 1 and one line on stderr when something is wrong with what it was given."""
    try:
        app()
    except HoidataError as error:
        from rich.console import Console
        from rich.markup import escape

        Console(stderr=True).print(f"[bold red]hoidata:[/] {escape(str(error))}", highlight=False, soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
