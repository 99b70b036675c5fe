"""Stage raw: write a generated corpus or check the user's raw files, and write their file-level manifest."""

from pathlib import Path

from hoidata.clips.clip import SourceFile
from hoidata.errors import BadInput, MissingResource
from hoidata.files.atomic import write_whole
from pipelines.lineage.closure import SourceTree
from pipelines.lineage.digests import value_digest
from pipelines.lineage.manifests import Manifest, scan_files, verify_files, write_manifest
from pipelines.stages.adapters import configured_adapter, manifest_of, raw_files, source_of
from pipelines.stages.base import StagePaths, hand_is_present, jobs, root_variable

SHOWN_DIFFERENCES = 5
WRITER = "hoidata.synthetic.corpus"


def run(paths: StagePaths) -> None:
    """Write ``raw.json``: the committed manifest, or for a generated corpus the manifest of its files."""
    manifest = manifest_of(paths)
    if manifest.present and manifest.synthetic:
        manifest = manifest.with_files(generated_files(paths, manifest))
    elif manifest.present:
        require_hand(paths)
        check_user_files(paths, manifest)
    write_manifest(paths.raw_manifest, manifest)
    print(f"{paths}: {len(manifest.files)} raw files" if manifest.present else f"{paths}: not present")


def generated_files(paths: StagePaths, manifest: Manifest) -> tuple[SourceFile, ...]:
    """Write the corpus of the manifest's recipe, unless recipe and code are unchanged, and list its files."""
    root = paths.generated_raw
    stamp = root.with_suffix(".recipe")
    if not (root.is_dir() and stamp.is_file() and stamp.read_text() == recipe_digest(manifest)):
        write_generated(paths, manifest, root)
    return scan_files(root, configured_adapter(paths.dataset).parts)


def recipe_digest(manifest: Manifest) -> str:
    """Digest of the recipe and of the code that writes the corpus."""
    return value_digest([manifest.recipe, SourceTree(Path()).closure([WRITER], {})])


def write_generated(paths: StagePaths, manifest: Manifest, root: Path) -> None:
    """Write the corpus of the manifest's recipe into ``root``, completely or not at all.

    The file ``<root>.recipe`` next to it marks it as generated, for ``convert`` and ``adapters check``.
    """
    from hoidata.synthetic.corpus import write_corpus

    recipe = manifest.recipe or {}
    if {name: type(value) for name, value in recipe.items()} != {"seed": int, "size": str}:
        raise BadInput(paths.manifest, "a recipe of seed and size", repr(recipe)[:80], "restore it with git checkout")
    write_corpus(source_of(paths.dataset), root, recipe["seed"], recipe["size"], jobs())
    write_whole(root.with_suffix(".recipe"), recipe_digest(manifest))


def require_hand(paths: StagePaths) -> None:
    """Raise MissingResource with a remedy if the dataset needs MANO files that are not registered."""
    adapter = configured_adapter(paths.dataset)
    if not adapter.needs_mano or hand_is_present(paths.profile):
        return
    key, _, value = getattr(adapter, "without_mano", "").partition("=")
    setting = f"; or set `{paths.dataset}: {{{key}: {value}}}` under `convert.adapters` in params.yaml" if key else ""
    raise MissingResource(
        f"{paths.dataset} has MANO parameters and no MANO files are registered. Register at "
        f"https://mano.is.tue.mpg.de, put MANO_RIGHT.pkl and MANO_LEFT.pkl into one folder, then run "
        f"`hoidata raw scan mano --root FOLDER` (it can also be named in {root_variable('hand')}){setting}"
    )


def check_user_files(paths: StagePaths, manifest: Manifest) -> None:
    """Compare the user's files with the scanned manifest. Raises BadInput that lists the first differences."""
    root = raw_files(paths)
    differences = verify_files(root, manifest, configured_adapter(paths.dataset).parts)
    if differences:
        shown = ", ".join(f"{item.path} ({item.problem})" for item in differences[:SHOWN_DIFFERENCES])
        got = f"{len(differences)} differences: {shown}"
        remedy = f"restore the files, or accept them with `hoidata raw scan {paths.dataset} --root {root}`"
        raise BadInput(root, f"the files listed in {paths.manifest}", got, remedy)
