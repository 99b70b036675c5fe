"""Stage tables: BimArt's Tables 1 and 3 from the rows of all runs, and Table 6 from recorded clips, as Markdown."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from hoidata.files import write_whole
from hoidata.files.written import Facts, read_json
from models.bimart_tables.rows import ROWS
from models.bimart_tables.variants import variant_of
from pipelines.promises import Kept, Promise, kept
from pipelines.stages.base import EMPTY, StagePaths, empty_reason, load_hands

RIVALS = ("nearest-window", "nearest-window-refined", "nearest-windows", "random-window", "mean-pose-at-object")
TABLES: Mapping[str, Sequence[str]] = {
    "Table 1: baselines": ("ground-truth", "cams-b", "mdm-b", "omomo-b", "bimart", *RIVALS),
    "Table 3: representations": ("unscaled", "whole", "mano", "stateless", "map"),
    "Table 3: contact": ("no-map", "map", "map-guided", "bimart"),
    "Controls": (
        *("ground-truth", "hands-still", "hands-shifted", "pressed-deep", "bimart", "other-path", "other-object"),
        "zero-map",
    ),
}
# Column, then the figures in it: as released / corrected.
COLUMNS = {
    "Mul, cm": ("bimart_mul_cm",),
    "Accel, cm/frame2 / m/s2": ("bimart_accel_paper", "bimart_accel_corrected"),
    "Pen 1 cm, %": ("bimart_pen_1cm_paper", "bimart_pen_1cm_corrected"),
    "Pen 5 mm, %": ("bimart_pen_5mm_paper", "bimart_pen_5mm_corrected"),
    "Con, %": ("bimart_con_paper", "bimart_con_corrected"),
    "Art, %": ("bimart_art_paper", "bimart_art_corrected"),
    "CM, cm": ("bimart_cm_paper", "bimart_cm_corrected"),
    "contact F1": ("contact_f1",),
    "joints, best sample, mm": ("joint_error_mm",),
}
NOTE = (
    "Figures as BimArt's release has them / corrected (hoidata/metrics/README.md); contact F1 and joints see where "
    "hands are. As released: of the first motion of each clip alone. Of several seeds the mean, in brackets the "
    "standard deviation. A best sample is the best of as many motions as a clip has: the more, the nearer."
)


def run(paths: StagePaths) -> None:
    """Write the tables; of a dataset without clips the reason alone."""
    if reason := empty_reason(paths.clips):
        write_whole(paths.tables, f"{reason}\n")
        return
    found = read_rows(paths)
    lines = [f"# BimArt's tables on {paths.profile}/{paths.dataset}", "", NOTE]
    for title, names in TABLES.items():
        if rows := [_row(found[name]) for name in names if name in found]:
            lines += ["", f"## {title}", "", *_table(("row", "seeds", "motions", *COLUMNS), rows)]
    lines += controls_lines(paths) + maps_lines(found)
    lines += ["", "## Table 6: error of contact maps seen by basis points, cm", "", *_mapping(paths)]
    write_whole(paths.tables, "\n".join(lines) + "\n")
    print(f"{paths}: {len(found)} rows, {paths.tables}")


def read_rows(paths: StagePaths) -> dict[str, list[Facts]]:
    """What was measured of each row, by its name, seed by seed."""
    known = [name for rows in ROWS.values() for name in rows]
    files = sorted(paths.table_rows.glob("*/*.json"))
    rows = [(file.stem, read_json(file)) for file in files if file.name != EMPTY]
    return {name: own for name in known if (own := [row for stem, row in rows if stem == name])}


def _row(seeds: list[Facts]) -> list[str]:
    """Title, how many seeds and motions, and the cells of a row."""
    measured = [seed for seed in seeds if "figures" in seed]
    if not measured:
        return [seeds[0]["title"], "0", seeds[0]["empty"], *["-"] * len(COLUMNS)]
    cells = [
        " / ".join(_cell(seed["figures"].get(name) for seed in measured) for name in own) for own in COLUMNS.values()
    ]
    return [seeds[0]["title"], str(len(measured)), str(sum(seed["motions"] for seed in measured)), *cells]


def controls_lines(paths: StagePaths) -> list[str]:
    """What every control must do beyond the 95 % interval over clips, and in how many runs it does."""
    found: dict[Promise, list[Kept]] = {}
    for folder in sorted(paths.table_rows.glob("*")):
        rows = _rows_by_family(folder)
        for one in kept(rows):
            if one.holds is not None and _as_many_chances(one.promise, rows):
                found.setdefault(one.promise, []).append(one)
    lines = []
    for promise, own in found.items():
        values = _cell(one.reference for one in own), _cell(one.value for one in own)
        holds = f"{sum(bool(one.holds) for one in own)} of {len(own)}"
        must = f"{promise.must}, beside {promise.beside}"
        lines.append([promise.control, promise.metric, must, *values, holds])
    title = "## What controls must do beyond the 95 % interval over clips"
    columns = ("control", "figure", "must", "beside", "control's", "runs in which it does")
    return ["", title, "", *_table(columns, lines)] if lines else []


def _as_many_chances(promise: Promise, rows: Mapping[str, Facts]) -> bool:
    """Whether a figure of both rows can be compared: the best of few motions is worse than the best of many."""
    from hoidata.metrics.registry import METRICS

    best_of = {metric.name for metric in METRICS if metric.reduction == "best of a clip's samples"}
    return promise.metric not in best_of or rows[promise.control]["motions"] == rows[promise.beside]["motions"]


def _rows_by_family(folder: Path) -> dict[str, Facts]:
    """The rows of a run that are a family as it stands in the registry, by its name."""
    rows = ROWS[variant_of(folder.name)[0]].items()
    paths = {row.family: folder / f"{name}.json" for name, row in rows if not row.settings}
    return {family: read_json(path) for family, path in paths.items() if path.is_file()}


def maps_lines(found: Mapping[str, list[Facts]]) -> list[str]:
    """How far drawn contact maps lie from the recorded ones, beside the object's mean map of training."""
    inside = [row["diagnostics"]["bimart-contact"] for row in found.get("bimart", []) if row.get("diagnostics")]
    rows = [[name, _cell(one[name] for one in inside)] for name in sorted(inside[0])] if inside else []
    return ["", "## Contact maps: error, mm", "", *_table(("of", "mm"), rows)] if rows else []


def _cell(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    spread = f" ({np.std(known, ddof=1):.2g})" if len(known) > 1 else ""
    return f"{np.mean(known):.3g}{spread}"


def _mapping(paths: StagePaths) -> list[str]:
    from hoidata.batches.dataset import HoiDataset
    from hoidata.store.annotated import load_annotated
    from models.bimart_tables.mapping import VARIANTS as SEEN
    from models.bimart_tables.mapping import WHERE, mapping_errors_cm

    hands = load_hands(paths.profile)
    found = mapping_errors_cm(list(HoiDataset(load_annotated(paths.data, hands), "test", crop="start")), hands)
    if not found:
        return ["No test clips."]
    found["mean"] = {kind: np.nanmean([own[kind] for own in found.values()], axis=0).tolist() for kind in SEEN}
    columns = [f"{where}: {kind}" for where in WHERE for kind in SEEN]
    rows = [
        [name, *(f"{own[kind][place]:.3f}" for place in range(len(WHERE)) for kind in SEEN)]
        for name, own in found.items()
    ]
    return _table(("object", *columns), rows)


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(own)} |" for own in (columns, ["---"] * len(columns), *rows)]
