"""What a GPU makes of Text2HOI at full size: steps per second of every network, and the seconds of a motion.

``python -m bench gpu`` on a machine with a GPU. HOIDATA_BENCH_DATA: a folder with clips, annotation, contact and splits
(data/embedded/grab); HOIDATA_BENCH_SECONDS: how long each training is watched (8). Sizes and settings are those of
params.yaml, size `full`. The paper's motion of 150 frames took 4.9 s on an RTX 4090 (Table S2).
"""

import math
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.harness import show
from hoidata.batches.dataset import MAX_FRAMES, ClipBatch, HoiDataset
from hoidata.batches.requests import Request
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import load_annotated
from models.common.family import Losses, Network, Objective
from models.common.predicting import PredictionConfig, requests_for
from models.common.repeatable import make_repeatable
from models.common.sampling import SamplerConfig
from models.common.training import TrainingConfig, train_network
from models.registry import load_network
from models.text2hoi.sampler import NETWORKS, SamplingConfig, Text2Hoi
from pipelines.params import laid_over
from pipelines.stages.base import load_settings
from pipelines.stages.train import TrainParams

PRESETS = ("paper", "ours")
BRIEFLY, WARM_UP = 10, 20  # steps
SEEN = 0.99  # of a corpus, before a training is watched: copies of clips are made and coded when they are first met
SAMPLERS = (SamplerConfig("dpm++", 20), SamplerConfig("ddim", 50), SamplerConfig("ddpm", 1000))
BATCHES, RUNS, PAPERS_S = (1, 32), 3, 4.9


class Watched(Exception):
    """Enough steps were seen."""


@dataclass
class Watch:
    """The objective of a training on a GPU, which is ended after so many seconds beyond the first ``warm_up`` steps.

    step_s: of a step by the clock. busy: share of the time in which the GPU computed, as nvidia-smi says it.
    validation_s: of one validation. memory_gib: the most that was taken.
    """

    objective: Objective
    seconds: float
    warm_up: int
    step: int = 0
    began: tuple[int, float] = (0, 0.0)
    step_s: float = 0.0
    busy: float = 0.0
    validation_s: float = 0.0
    memory_gib: float = 0.0
    meter: "Meter | None" = None

    @property
    def network(self) -> nn.Module:
        return self.objective.network

    @property
    def frames(self) -> int:
        return self.objective.frames

    @property
    def entries(self) -> int:
        return self.objective.entries

    def validation(self, network: nn.Module) -> Tensor:
        return self.objective.validation(network)

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        self.step += 1
        if self.step == self.warm_up:
            torch.cuda.reset_peak_memory_stats()
            self.began, self.meter = (self.step, _now()), Meter()
        elif self.meter and time.perf_counter() - self.began[1] > self.seconds:
            self._finish(self.meter)
            raise Watched
        return self.objective.losses(batch, generator)

    def _finish(self, meter: "Meter") -> None:
        self.step_s = (_now() - self.began[1]) / (self.step - self.began[0])
        self.busy = meter.read()
        self.memory_gib = torch.cuda.max_memory_allocated() / 2**30
        start = _now()
        self.objective.validation(self.network.eval())
        self.validation_s = _now() - start


class Meter:
    """nvidia-smi beside a training: in how much of the time the GPU computed."""

    def __init__(self) -> None:
        query = ["--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", "-lms", "200"]
        card = f"--id=GPU-{torch.cuda.get_device_properties(0).uuid}"
        self.process = subprocess.Popen(["nvidia-smi", card, *query], stdout=subprocess.PIPE, text=True)

    def read(self) -> float:
        """The mean so far, but for the first second, which looks back; nothing is read after it."""
        self.process.terminate()
        found = [int(line) for line in self.process.communicate()[0].split() if line.isdigit()][5:]
        return sum(found) / len(found) / 100 if found else float("nan")


def main() -> None:
    if not torch.cuda.is_available():
        print("no GPU: torch finds none")
        return
    make_repeatable(threads=1)
    data = Path(os.environ.get("HOIDATA_BENCH_DATA", "data/embedded/grab"))
    seconds, train = float(os.environ.get("HOIDATA_BENCH_SECONDS", "8")), load_settings(TrainParams, "train")
    annotated = load_annotated(data, load_embedded_hands())
    longest = max(HoiDataset(annotated, "train", crop="start"), key=lambda sample: sample.length)
    asked = replace(requests_for(longest, PredictionConfig())[0], active_hands=np.ones(2, bool), n_frames=MAX_FRAMES)
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {data}")
    with tempfile.TemporaryDirectory() as folder:
        for preset in PRESETS:
            trained = Path(folder, preset)
            rows = list(told(training_rows(data, trained, replace(train, preset=preset, size="full"), seconds)))
            columns = ["network", "precision", "steps/s", "busy", "GiB", "validation s", "steps", "hours"]
            show(f"Training of `{preset}` at full size", columns, rows)
        rows = [row for preset in PRESETS for row in told(motion_rows(Path(folder, preset), preset, asked))]
        columns = ["preset", "way", "precision", *(f"{count} at once, s" for count in BATCHES), "paper / 1 at once"]
        show(f"Motions of {MAX_FRAMES} frames and both hands at full size, contact and refinement in it", columns, rows)


def told(rows: Iterator[Sequence[str]]) -> Iterator[Sequence[str]]:
    """The rows, each printed as soon as it is there: a lent machine may be taken back."""
    for row in rows:
        print(*row, sep="  ", flush=True)
        yield row


def training_rows(data: Path, trained: Path, train: TrainParams, seconds: float) -> Iterator[Sequence[str]]:
    """One row per network and precision; ``trained`` is filled with networks of a few steps, on which others build."""
    for network in NETWORKS:
        needed, settings = {load_network(name): trained / name for name in network.needs}, train.of(network.name)
        fit = partial(train_network, annotated_root=data, needed=needed, device="cuda")
        brief = laid_over(settings, {"training": {"steps": BRIEFLY}})
        fit(network, out_folder=trained / network.name, params=brief)
        for precision in ("float32", "bfloat16") if network.name == "diffusion" else ("float32",):
            own = laid_over(settings, {"training": {"precision": precision}})
            training = own["training"]
            train_once = partial(fit, out_folder=trained / "none", params=own)
            met = training.get("augmented_copies", 0), training.get("batch", TrainingConfig.batch)
            watch = watched(network, train_once, seconds, *met)
            steps, validations = training["steps"], training["steps"] / training.get("validate_every", 500)
            hours = (steps * watch.step_s + validations * watch.validation_s) / 3600
            figures = [1 / watch.step_s, watch.busy, watch.memory_gib, watch.validation_s]
            yield [network.name, precision, *(f"{figure:.2f}" for figure in figures), f"{steps:,}", f"{hours:.2f}"]


def steps_until_seen(clips: int, batch: int) -> int:
    """After how many steps a share ``SEEN`` of so many clips has been met, each step drawing a batch of them."""
    return max(WARM_UP, math.ceil(-math.log(1 - SEEN) * clips / batch))


def watched(network: Network, fit: Callable[[Network], object], seconds: float, copies: int, batch: int) -> Watch:
    """What was seen of a training of ``network``, which ``fit`` begins, once it has met its clips and their copies."""
    watches: list[Watch] = []

    def objective(setup: Any) -> Any:
        made, normaliser = network.objective(setup)
        clips = len(setup.corpus.train) * (1 + copies)
        watches.append(Watch(made, seconds, steps_until_seen(clips, batch)))
        return watches[0], normaliser

    with suppress(Watched):
        fit(replace(network, objective=objective))
    return watches[0]


def motion_rows(trained: Path, preset: str, asked: Request) -> Iterator[Sequence[str]]:
    """One row per sampler and precision: seconds of motions made one at a time, and many at once.

    1,000 steps are walked in float32 alone, once, for one motion.
    """
    pair = load_embedded_hands()
    for precision in ("float32", "bfloat16", "float16"):
        for sampler in SAMPLERS if precision == "float32" else SAMPLERS[:-1]:
            config = SamplingConfig(sampler, precision=precision, draws=1)
            family = Text2Hoi.load(trained, pair, config, "cuda")
            long = sampler is SAMPLERS[-1]
            seconds = [motions_s(family, asked, count, 1 if long else RUNS) for count in BATCHES[: 1 if long else None]]
            cells = [f"{own:.2f}" for own in seconds] + ["-"] * long
            way = f"{sampler.kind}, {sampler.steps} steps"
            yield [preset, way, precision, *cells, f"{PAPERS_S / seconds[0]:.1f}"]


def motions_s(family: Text2Hoi, asked: Request, count: int, runs: int) -> float:
    """Seconds by the clock for ``count`` motions of different seeds, the middle of some runs."""
    requests = [replace(asked, seed=seed) for seed in range(count)]
    times = []
    for _ in range(runs):
        start = _now()
        family.motions(requests)
        times.append(_now() - start)
    return sorted(times)[runs // 2]


def _now() -> float:
    """The clock, once the device has done all it was given."""
    torch.cuda.synchronize()
    return time.perf_counter()


if __name__ == "__main__":
    main()
