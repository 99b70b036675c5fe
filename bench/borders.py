"""Whether long motions show where their windows meet, beside windows made apart and joined, in one run.

``python -m bench borders``. Twenty scripted paths of 300 frames with objects of the dataset whose networks are trained
(HOIDATA_BENCH_BIMART: a folder with bimart-contact and bimart-motion; ``checkpoints/embedded/arctic`` by default; clips
of HOIDATA_BENCH_DATA, ``data/embedded/arctic``). HOIDATA_BENCH_PATHS: fewer of them. Then how much longer twice as many
frames take.
"""

import os
import time
from pathlib import Path

import torch

from bench.harness import show
from hoidata.clips import ObjectTrack
from hoidata.hands import load_embedded_hands
from hoidata.object_paths import scripted_path
from hoidata.objects.model import ObjectModel
from hoidata.store.annotated import load_annotated
from models.bimart.borders import border_figures, borders_of, made_apart, overlapping_borders_of
from models.bimart.family import HandsForPaths
from models.bimart.hands import MotionWish, hands_for
from models.common.family import Sources

FRAMES, PATHS, TIMED = 300, 20, 3
SCRIPTS = (
    "lift 15 cm, hold 1 s, tilt 25 deg left, hold 1 s, level, turn 60 deg right, hold 1 s, put down",
    "lift 20 cm, move right 20 cm, hold 1 s, tilt 20 deg forward, hold 1 s, move left 20 cm, level, put down",
    "lift 12 cm, turn 80 deg left, hold 1.5 s, turn 80 deg right, shake 2 cm 3 times, hold 1 s, put down",
    "lift 25 cm in 1.5 s, tilt 30 deg right, hold 2 s, level, move away 15 cm, hold 1 s, put down in 1.5 s",
)


def main() -> None:
    torch.set_num_threads(1)
    pair = load_embedded_hands()
    data = load_annotated(os.environ.get("HOIDATA_BENCH_DATA", "data/embedded/arctic"), pair)
    folder = Path(os.environ.get("HOIDATA_BENCH_BIMART", "checkpoints/embedded/arctic"))
    sampler = HandsForPaths.load(Sources(data, folder, pair, torch.device("cpu")))
    window = sampler.model.motion.config.features.window
    names, count = list(data.store.objects["object"]), int(os.environ.get("HOIDATA_BENCH_PATHS", PATHS))
    models = [data.store.object_model(names[number % len(names)]) for number in range(count)]
    together, apart, seconds = [], [], []
    for number, model in enumerate(models):
        thing, wish = path(model, number, FRAMES), MotionWish(seed=100 * number)
        start = time.process_time()
        together.append(hands_for(sampler, thing, wish)[0].clip)
        seconds.append(time.process_time() - start)
        apart.append(made_apart(sampler, thing, wish, window))
    ours, theirs = overlapping_borders_of(FRAMES, window), borders_of(FRAMES, window)
    rows = []
    for name, clips, borders in (
        ("windows made together, every frame where one begins or ends", together, ours),
        ("windows made together, where those made apart meet", together, theirs),
        ("windows made apart and joined", apart, theirs),
    ):
        acceleration, contact = border_figures(clips, pair, borders)
        rows.append([name, f"{len(borders)}", f"{acceleration:.2f}x", f"{contact:.2f}x"])
    title = f"{count} paths of {FRAMES} frames, windows of {window}; {sum(seconds) / count:.1f} s each"
    show(
        title,
        ["at borders over elsewhere", "borders", "95th percentile of acceleration", "rate of contact changes"],
        rows,
    )
    twice = []
    for number in range(count)[1 : 1 + TIMED]:  # the first one compiles
        start = time.process_time()
        hands_for(sampler, path(models[number], number, 2 * FRAMES), MotionWish(seed=100 * number))
        twice.append((time.process_time() - start) / seconds[number])
    ratios = ", ".join(f"{ratio:.2f}x" for ratio in twice)
    print(f"{2 * FRAMES} frames of {len(twice)} paths take {ratios} the processor time of {FRAMES}")


def path(model: ObjectModel, number: int, frames: int) -> ObjectTrack:
    """A script for the object, held at its end until there are so many frames."""
    return scripted_path(model, SCRIPTS[number % len(SCRIPTS)] + ", hold 30 s").track.take(slice(0, frames))
