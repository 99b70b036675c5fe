"""``python -m bench [NAME ...]``: the benchmarks named (see ``BENCHMARKS``), or all, one after another.

Every figure stands beside a named baseline of the same run; variants take turns and medians of at least five runs are
shown. Nothing here passes or fails by time. HOIDATA_BENCH_CORPORA: a folder with the embedded raw corpora.
"""

import sys

from bench import (
    ablation,
    adapters,
    batches,
    bimart,
    evaluate,
    evaluator,
    gpu,
    kernels,
    manipnet,
    manipnet_across,
    manipnet_course,
    manipnet_speed,
    physics,
    realism,
    refinement,
    samplers,
    scale,
    sensors,
    store,
    surface,
    text,
    verbs,
)

BENCHMARKS = {
    "adapters": adapters.main,
    "store": store.main,
    "scale": scale.main,
    "kernels": kernels.main,
    "surface": surface.main,
    "sensors": sensors.main,
    "bimart": bimart.main,
    "physics": physics.main,
    "realism": realism.main,
    "text": text.main,
    "verbs": verbs.main,
    "batches": batches.main,
    "samplers": samplers.main,
    "gpu": gpu.main,
    "ablation": ablation.main,
    "evaluate": evaluate.main,
    "evaluator": evaluator.main,
    "fingers": manipnet_speed.main,
    "refinement": refinement.main,
    "manipnet": manipnet.main,
    "manipnet-course": manipnet_course.main,
    "manipnet-across": manipnet_across.main,
}


def main() -> int:
    chosen = sys.argv[1:] or list(BENCHMARKS)
    unknown = sorted(set(chosen) - set(BENCHMARKS))
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 1
    for name in chosen:
        BENCHMARKS[name]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
