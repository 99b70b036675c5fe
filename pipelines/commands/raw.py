"""``hoidata raw`` and ``hoidata profile``: the user's raw files, and the choice of the data to work on."""

from pathlib import Path
from typing import Annotated

import typer

from hoidata.errors import BadInput, MissingResource
from pipelines.commands.project import current_profile, enter_project, remember_root, set_profile
from pipelines.params import PROFILES, read_params

app = typer.Typer(no_args_is_help=True)
Dataset = Annotated[str, typer.Argument(help="A dataset of params.yaml, or mano for the MANO files.")]
SHOWN_DIFFERENCES = 50
MANO_FILES = ("MANO_RIGHT.pkl", "MANO_LEFT.pkl")


@app.command()
def scan(
    dataset: Dataset,
    root: Annotated[
        Path, typer.Option(help="Folder with the raw files.", exists=True, file_okay=False, resolve_path=True)
    ],
) -> None:
    """Write the manifest of your raw files of a dataset, register their folder, and switch to the profile own."""
    enter_project()
    from pipelines.lineage.manifests import write_manifest
    from pipelines.stages.adapters import ensure_manifests, source_of
    from pipelines.stages.base import HAND, StagePaths

    name = HAND if dataset == "mano" else dataset
    paths = StagePaths("own", name)
    manifest = _scan_hand(paths, root) if name == HAND else _scan_dataset(paths, root)
    datasets = read_params(Path())["datasets"]
    ensure_manifests("own", datasets)
    for variant in (name, *(other for other in datasets if other != name and source_of(other) == name)):
        write_manifest(StagePaths("own", variant).manifest, manifest)
    remember_root(name, root)
    size = sum(entry.size for entry in manifest.files)
    typer.echo(f"{paths.manifest}: {len(manifest.files)} entries, {size / 1e6:.1f} MB; {root} noted in hoidata.toml")
    if name == HAND:
        return
    typer.echo(f"{manifest.dataset} {manifest.version}: {manifest.licence}")
    if not manifest.may_be_shared:
        typer.echo("Data derived from it stays on this machine: `dvc push` skips it (see `hoidata share --help`)")
    if set_profile("own"):
        typer.echo("params.yaml: profile set to own (`hoidata profile embedded` returns; nothing is retrained)")


def profile(
    name: Annotated[str, typer.Argument(help="embedded, study or own. Default: print the current one.")] = "",
) -> None:
    """Print or choose the profile, the data that the project works on; it is the line profile of params.yaml."""
    enter_project()
    if name:
        if name not in PROFILES:
            raise BadInput("hoidata profile", " or ".join(PROFILES), name, "choose one of them")
        set_profile(name)
    typer.echo(current_profile())


def _scan_dataset(paths, root: Path):
    from pipelines.lineage.manifests import absent_manifest, scan_files
    from pipelines.stages.adapters import configured_adapter
    from pipelines.stages.raw import require_hand

    datasets = read_params(Path())["datasets"]
    adapter = configured_adapter(paths.dataset)
    if paths.dataset not in datasets:
        remedy = f"add {paths.dataset} to `datasets` in params.yaml"
        raise BadInput("params.yaml: datasets", paths.dataset, f"only {', '.join(datasets)}", remedy)
    # A problem of the folder is reported before a missing hand model.
    try:
        require_hand(paths)
    except MissingResource as error:
        _require_parts(adapter, root, also=str(error))
        raise
    _require_parts(adapter, root)
    return absent_manifest(adapter).with_files(scan_files(root, adapter.parts))


def _require_parts(adapter, root: Path, also: str = "") -> None:
    """Raise BadInput, with the problem ``also``, if the folder lacks a required part; print missing optional parts."""
    from pipelines.lineage.manifests import missing_parts

    missing = missing_parts(adapter, root)
    required = [part for part in missing if not part.optional]
    if required or not adapter.sequences(root):
        parts = "; ".join(f"{part.contents} ({part.patterns[0]}, from {part.archive})" for part in required)
        got = f"no {parts}" if parts else "none"
        remedy = f"name the folder that {adapter.name} unpacks to; register at {adapter.where_to_register}"
        if settings := {part.unneeded_with for part in required if part.unneeded_with}:
            key, _, value = ", ".join(sorted(settings)).partition("=")
            remedy += f"; or set `{adapter.name}: {{{key}: {value}}}` under `convert.adapters` in params.yaml, "
            remedy += "which does not need it"
        remedy += f". Also, {also}" if also else ""
        raise BadInput(root, f"sequences of {adapter.name}", got, remedy)
    for part in missing:
        typer.echo(f"{adapter.name}: without {part.contents} ({part.patterns[0]}), available from {part.archive}")


def _scan_hand(paths, root: Path):
    from hoidata.clips.clip import SourceFile
    from hoidata.files import sha256_file
    from pipelines.lineage.manifests import ABSENT_HAND

    missing = [name for name in MANO_FILES if not (root / name).is_file()]
    if missing:
        raise BadInput(root, " and ".join(MANO_FILES), f"no {', '.join(missing)}", "see https://mano.is.tue.mpg.de")
    files = [SourceFile(name, (root / name).stat().st_size, sha256_file(root / name)) for name in sorted(MANO_FILES)]
    return ABSENT_HAND.with_files(tuple(files))


@app.command()
def verify(dataset: Annotated[str, typer.Argument(help="A dataset. Default: all that are present.")] = "") -> None:
    """Compare raw files with the manifests of the current profile; the exit code is 1 if they differ or are missing."""
    enter_project()
    names = [dataset] if dataset else read_params(Path())["datasets"]
    results = [_verify_one(name, is_required=bool(dataset)) for name in names]
    raise typer.Exit(0 if all(results) else 1)


def _verify_one(dataset: str, is_required: bool) -> bool:
    """Print the differences of one dataset's files from its manifest. Returns whether they agree, or may be absent."""
    from pipelines.lineage.manifests import part_of, read_manifest, verify_files
    from pipelines.stages.adapters import configured_adapter, manifest_of, raw_files
    from pipelines.stages.base import StagePaths

    paths, adapter = StagePaths(current_profile(), dataset), configured_adapter(dataset)
    manifest = manifest_of(paths)
    if not manifest.present:
        typer.echo(f"{dataset}: not present in the profile {paths.profile}: no raw files were scanned")
        _print_sources(adapter)
        return not is_required
    try:
        root = raw_files(paths)
    except MissingResource as error:
        typer.echo(f"{dataset}: {error}")
        _print_sources(adapter)
        return False
    listed = read_manifest(paths.raw_manifest) if manifest.synthetic else manifest
    differences = verify_files(root, listed, adapter.parts)
    for item in differences[:SHOWN_DIFFERENCES]:
        part = part_of(adapter, item.path)
        where_to_get = f"{part.contents}, from {part.archive}" if part else adapter.where_to_register
        typer.echo(f"{dataset}: {item.path} is {item.problem} ({where_to_get})")
    if len(differences) > SHOWN_DIFFERENCES:
        typer.echo(f"{dataset}: and {len(differences) - SHOWN_DIFFERENCES} more")
    typer.echo(f"{dataset}: {len(listed.files)} entries, differences: {len(differences) or 'none'}")
    return not differences


def _print_sources(adapter) -> None:
    """Print the licence, the parts of a dataset with their download pages, and the next command."""
    typer.echo(f"  {adapter.licence}; {adapter.where_to_register}")
    for part in adapter.parts:
        optional = " (optional)" if part.optional else ""
        if part.unneeded_with and not part.optional:
            optional = f" (not needed with the setting {part.unneeded_with})"
        typer.echo(f"  missing: {part.contents} ({part.patterns[0]}), from {part.archive}{optional}")
    typer.echo(f"  once you have it: hoidata raw scan {adapter.name} --root FOLDER")
