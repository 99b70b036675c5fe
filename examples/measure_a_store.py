"""Metrics of any store of clips <reference id>~<k>: python examples/measure_a_store.py mine data/embedded/grab"""

import sys

from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store

if __name__ == "__main__":  # workers import this file
    result = evaluate_store(sys.argv[1], sys.argv[2], load_embedded_hands())
    print(f"{result['motions']} motions of {result['held_out_clips']} clips")
    for name, value in result["figures"].items():
        print(f"{name:28s} {value:.4g}")
    for name, reasons in result["unmeasured"].items():
        print(f"{name:28s} not measured: {', '.join(f'{why}: {clips} clips' for why, clips in reasons.items())}")
