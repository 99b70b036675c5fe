"""``python -m bench [NAME ...]``: the benchmarks named (see ``BENCHMARKS``), or all but those ``ON_REQUEST``.

``python -m bench table1 CORPUS``, ``table2 CORPUS`` and ``presets CORPUS`` make tables of Text2HOI (``paper_tables``).

Every result stands next to a named baseline of the same run; variants take turns and medians of several runs are shown.
Nothing here passes or fails by time. HOIDATA_BENCH_CORPORA: a folder with the embedded raw corpora.
"""

import sys

from bench import adapters, bimart_tables, kernels, paper_tables, recordings, samplers, scale, soak, speed

BENCHMARKS = {
    "adapters": adapters.main,
    "scale": scale.main,
    "kernels": kernels.main,
    "samplers": samplers.main,
    "bimart-tables": bimart_tables.main,
    "recordings": recordings.main,
    "soak": soak.main,
    "speed": speed.main,
}
ON_REQUEST = ("bimart-tables", "recordings", "soak", "speed")  # they need data or a network, and run for hours


def main() -> int:
    if sys.argv[1:2] and (name := sys.argv[1]) in ("table1", "table2", "presets"):
        return paper_tables.make(name, " ".join(sys.argv[2:]))
    chosen = sys.argv[1:] or [name for name in BENCHMARKS if name not in ON_REQUEST]
    unknown = sorted(set(chosen) - set(BENCHMARKS))
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 1
    for name in chosen:
        BENCHMARKS[name]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
