"""BimArt compared with its baselines on one dataset: train, sample and measure every method in one run.

``python -m bench bimart-tables`` in a project. HOIDATA_BENCH_DATA: a folder with clips, annotation, contact and splits
(data/embedded/arctic); HOIDATA_BENCH_SIZE: small or full, as in params.yaml; HOIDATA_BENCH_SAMPLES: motions per clip
(4); HOIDATA_BENCH_CLIPS: test clips, 0 for all (16); HOIDATA_BENCH_SEED: of all random numbers (0);
HOIDATA_BENCH_METHODS: names of methods with commas (all). Networks and motions are stored in HOIDATA_BENCH_OUT
(.hoidata/bimart-tables); existing networks are not trained again.

The nearest training window, refined as ours, is the retrieval baseline. Only CAMS-B is conditioned on recorded hands:
those of the first frame, and when each hand touches which part.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bench.bimart_baselines import CAMS_B, MDM_B, OMOMO_B
from bench.harness import show
from hoidata.files.written import read_json
from hoidata.hands import HandPair
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.optional_metrics import select_metrics
from hoidata.settings import build_config
from models.common.checkpoints import FILE_NAME
from models.common.family import Family, Network
from models.common.predicting import sample_family
from models.common.repeatable import chosen_device
from models.common.training import train_network
from models.registry import load_family
from pipelines.params import read_params
from pipelines.stages.base import load_hands
from pipelines.stages.train import TrainParams

BASELINE_TRAINING = {
    "small": {"steps": 2000, "batch": 16, "learning_rate": 1e-3, "warmup": 50, "ema_decay": 0.99},
    "full": {"steps": 100_000, "batch": 64, "learning_rate": 2e-4, "warmup": 500, "ema_decay": 0.999},
}
# Column, then its metrics: as released / corrected.
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


@dataclass(frozen=True)
class Method:
    """A method of the table."""

    title: str
    load: Callable[[], Family]
    preset: str = ""  # of BimArt's networks and sampling
    samples: int | None = None  # motions per clip; None: those of the run


def _of_registry(name: str) -> Callable[[], Family]:
    return lambda: load_family(name)


METHODS = {
    "ground-truth": Method("recorded clips", _of_registry("ground-truth"), samples=1),
    "nearest-window": Method("nearest training window", _of_registry("nearest-window"), samples=1),
    "nearest-window-refined": Method("the same, refined", _of_registry("nearest-window-refined"), samples=1),
    "mean-pose": Method("mean pose at the object", _of_registry("mean-pose-at-object"), samples=1),
    "cams-b": Method(CAMS_B.title, lambda: CAMS_B),
    "mdm-b": Method(MDM_B.title, lambda: MDM_B),
    "omomo-b": Method(OMOMO_B.title, lambda: OMOMO_B),
    "paper": Method("BimArt, paper", _of_registry("bimart"), "paper"),
    "ours-unrefined": Method("BimArt, ours, before refinement", _of_registry("bimart-unrefined"), "ours"),
    "ours": Method("BimArt, ours", _of_registry("bimart"), "ours"),
}


@dataclass(frozen=True)
class Run:
    """One run of the comparison."""

    data: Path  # an annotated dataset
    out: Path  # folder of networks and motions
    hands: HandPair
    train: TrainParams  # section ``train`` of params.yaml
    baselines: Mapping[str, Any]  # section ``training`` of the baselines' networks
    settings: Mapping[str, Any] = field(default_factory=dict)  # section ``sample.bimart``
    samples: int = 4  # motions per clip
    clips: int = 16  # test clips; 0: all
    seed: int = 0
    device: str = "cpu"

    def evaluate(self, name: str) -> dict[str, Any]:
        """Train and sample a method; the result of ``evaluate_store``, or the reason under ``empty`` if none."""
        method, folder = METHODS[name], self.out / "motions" / name
        family = replace(method.load(), name=name, diagnose=lambda sources: {})
        networks = self.out / "networks" / (method.preset or "baselines")
        bimart_networks = [network for network in load_family("bimart").networks if network.name in family.uses]
        for network in family.networks or bimart_networks:
            self._train(network, networks, method.preset)
        options = {"samples": method.samples or self.samples, "seed": self.seed, "clips": self.clips}
        settings = {"bimart": self.settings}
        counts = sample_family(
            family, self.data, networks, folder, options, self.hands, settings=settings, device=self.device
        )
        if not counts["clips"]:
            return read_json(folder / "empty.json")
        return evaluate_store(folder / "clips", self.data, self.hands, metrics=select_metrics(["bimart"]))

    def _train(self, network: Network, folder: Path, preset: str) -> None:
        if (folder / network.name / FILE_NAME).is_file():
            return
        params = replace(self.train, preset=preset).of(network.name) if preset else {"training": self.baselines}
        params = {**params, "seed": self.seed}
        train_network(network, self.data, folder / network.name, params, self.hands, device=self.device)


def rows(run: Run, names: Sequence[str]) -> list[list[str]]:
    """The table: per method its title, number of motions, and a cell per column."""
    table = []
    for name in names:
        result = run.evaluate(name)
        metrics = result.get("figures", {})
        cells = [" / ".join(_cell(metrics.get(metric)) for metric in column) for column in COLUMNS.values()]
        table.append([METHODS[name].title, str(result.get("motions", result.get("empty"))), *cells])
    return table


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def main() -> None:
    variables = {name: os.environ.get(f"HOIDATA_BENCH_{name}", "") for name in ("DATA", "OUT", "SIZE", "METHODS")}
    numbers = {name: os.environ.get(f"HOIDATA_BENCH_{name.upper()}") for name in ("samples", "clips", "seed")}
    data, params = Path(variables["DATA"] or "data/embedded/arctic"), read_params(Path())
    size = variables["SIZE"] or params["train"]["size"]
    run = Run(
        data=data,
        out=Path(variables["OUT"] or ".hoidata/bimart-tables"),
        hands=load_hands(data.parent.name),
        train=build_config(TrainParams, {**params["train"], "size": size}, "params.yaml: train"),
        baselines=BASELINE_TRAINING[size],
        device=chosen_device(params.get("device", "auto")),
        **{name: int(value) for name, value in numbers.items() if value},
    )
    names = variables["METHODS"].split(",") if variables["METHODS"] else list(METHODS)
    show(f"{data}: {size} networks, as released / corrected", ("method", "motions", *COLUMNS), rows(run, names))
