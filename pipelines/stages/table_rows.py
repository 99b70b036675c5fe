"""Stage table_rows: the rows of one variant and seed of BimArt's tables, sampled and measured."""

import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hoidata.errors import BadInput
from hoidata.files import write_whole
from hoidata.files.atomic import atomic_folder
from hoidata.files.digest import canonical_json
from hoidata.files.written import Facts, read_json
from models.bimart_tables.rows import ROWS, Row
from models.bimart_tables.variants import VARIANTS, Settings, variant_of
from models.registry import load_family
from pipelines.lineage.digests import path_digest, value_digest
from pipelines.params import laid_over
from pipelines.stages.base import (
    StagePaths,
    empty_reason,
    jobs,
    load_hands,
    load_settings,
    read_section,
    write_empty,
    write_json,
)  # fmt: skip

CODE = Path("code/table_rows.json")
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
    """A file of figures per row; of a dataset without clips the reason alone.

    A killed run goes on after the rows it had measured, where nothing that they come from has changed.
    """
    variant, _ = variant_of(paths.family)
    settings, sample = load_settings(TableSettings, "tables"), read_section("sample")
    if reason := empty_reason(paths.clips):
        write_empty(paths.table_rows, reason)
    else:
        rows = _rows(paths, ROWS[variant], settings, sample)
        with atomic_folder(paths.table_rows) as partial:
            for name, found in rows.items():
                write_json(partial / f"{name}.json", found)
    shutil.rmtree(measured_in(paths), ignore_errors=True)


def measured_in(paths: StagePaths) -> Path:
    """Where rows lie until all of a run are measured."""
    return Path(".hoidata") / paths.table_rows


def _rows(paths: StagePaths, rows: Mapping[str, Row], settings: TableSettings, sample: Settings) -> dict[str, Facts]:
    """What was measured of every row, now or by a run that was killed; each is kept as soon as it is measured."""
    folder, found = measured_in(paths) / _made_from(paths, settings, sample), {}
    for name, row in rows.items():
        path = folder / f"{name}.json"
        if _is_whole(path):
            print(f"{paths}: {name}: measured by a run before", flush=True)
        else:
            write_whole(path, canonical_json(_measured(paths, name, row, settings, sample)))
        found[name] = read_json(path)
    return found


def _made_from(paths: StagePaths, settings: TableSettings, sample: Settings) -> str:
    """A digest of everything that rows come from: settings, code, data with objects and hands, networks."""
    inputs = (CODE, paths.clips, paths.annotation, paths.contact, paths.splits, paths.table_networks)
    return value_digest([sample, settings.samples, settings.clips, *map(path_digest, inputs)])


def _is_whole(path: Path) -> bool:
    """Whether a row was kept, and can be read."""
    with suppress(BadInput):
        return bool(read_json(path))
    return False


def _measured(paths: StagePaths, name: str, row: Row, settings: TableSettings, sample: Settings) -> dict[str, Any]:
    """The figures of one row, and its title."""
    from hoidata.metrics.asked_metrics import BIMART_METRICS
    from hoidata.metrics.evaluate import evaluate_store
    from hoidata.metrics.registry import METRICS
    from models.common.predicting import sample_family
    from models.common.repeatable import make_repeatable

    make_repeatable(threads=1)
    variant, seed = variant_of(paths.family)
    family = replace(load_family(row.family), name=name, uses=tuple(VARIANTS[variant]))
    if row.settings:  # figures inside the networks are theirs, however they are sampled
        family = replace(family, diagnose=lambda sources: {})
    samples = min(settings.samples, row.most_samples or settings.samples)
    sampled = {"samples": samples, "seed": seed, "clips": settings.clips}
    own = {"bimart": laid_over(sample.get("bimart") or {}, row.settings)}
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
    kept = ("motions", "figures", "intervals", "counts", "unmeasured", "synthetic", "by_clip")
    return {"title": row.title, **{key: found[key] for key in kept}, "diagnostics": inside}
