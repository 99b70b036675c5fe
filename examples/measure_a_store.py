"""Figures of any store of clips <reference id>~<k>: python examples/measure_a_store.py mine data/embedded/grab"""

import sys

from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store

if __name__ == "__main__":  # workers import this file
    found = evaluate_store(sys.argv[1], sys.argv[2], load_embedded_hands())
    print(f"{found['motions']} motions of {found['held_out_clips']} clips")
    for name, value in found["figures"].items():
        print(f"{name:28s} {value:.4g}")
    for name, reasons in found["unmeasured"].items():
        print(f"{name:28s} not measured: {', '.join(f'{why}: {clips} clips' for why, clips in reasons.items())}")
