"""Stage table_rows: the rows of one variant and seed of BimArt's tables, sampled and measured."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from hoidata.files.atomic import atomic_folder
from hoidata.files.written import read_json
from models.bimart_tables.rows import ROWS, Row
from models.bimart_tables.variants import VARIANTS, variant_of
from models.registry import load_family
from pipelines.params import laid_over
from pipelines.stages.base import (
    StagePaths,
    empty_reason,
    jobs,
    load_hands,
    load_settings,
    note_empty,
    read_section,
    write_json,
)  # fmt: skip

BESIDE = ("joint_error_mm", "contact_f1")  # figures that see where a hand is, beside BimArt's own


@dataclass(frozen=True)
class TableSettings:
    """datasets, runs: which; runs are variants and seeds of ``models/bimart_tables/variants.py``.

    samples: motions per clip. clips: evenly spread test clips; 0: all.
    """

    datasets: tuple[str, ...] = ()
    runs: tuple[str, ...] = ()
    samples: int = 1
    clips: int = 0


def run(paths: StagePaths) -> None:
    """A file of figures per row; of a dataset without clips the reason alone."""
    variant, seed = variant_of(paths.family)
    networks = tuple(VARIANTS[variant])
    settings = load_settings(TableSettings, "tables")
    with atomic_folder(paths.table_rows) as partial:
        if reason := empty_reason(paths.clips):
            note_empty(partial, reason)
            return
        for name, row in ROWS[variant].items():
            write_json(partial / f"{name}.json", _measured(paths, name, row, networks, seed, settings))


def _measured(
    paths: StagePaths, name: str, row: Row, networks: tuple[str, ...], seed: int, settings: TableSettings
) -> dict:
    """The figures of one row, and its title."""
    from hoidata.metrics.asked_metrics import BIMART_METRICS
    from hoidata.metrics.evaluate import evaluate_store
    from hoidata.metrics.registry import METRICS
    from models.common.predicting import sample_family
    from models.common.repeatable import make_repeatable

    make_repeatable(threads=1)
    family = replace(load_family(row.family), name=name, uses=networks)
    if row.settings:  # figures inside the networks are theirs, however they are sampled
        family = replace(family, diagnose=lambda sources: {})
    samples = min(settings.samples, row.most_samples or settings.samples)
    sampled = {"samples": samples, "seed": seed, "clips": settings.clips}
    own = {"bimart": laid_over(read_section("sample").get("bimart") or {}, row.settings)}
    metrics = tuple(one for one in METRICS if one.name in BESIDE) + tuple(
        one for one in BIMART_METRICS if one.topic == "BimArt"
    )
    hands = load_hands(paths.profile)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "motions"
        counts = sample_family(family, paths.data, paths.table_networks, out, sampled, hands, settings=own)
        if not counts["clips"]:
            return {"title": row.title, "empty": empty_reason(out)}
        found = evaluate_store(out / "clips", paths.data, hands, metrics=metrics, jobs=jobs(), by_clip=True)
        inside = read_json(out / "diagnostics.json")
    print(f"{paths}: {name}: {counts['clips']} motions", flush=True)
    kept = ("motions", "figures", "intervals", "counts", "synthetic", "by_clip")
    return {"title": row.title, **{key: found[key] for key in kept}, "diagnostics": inside}
