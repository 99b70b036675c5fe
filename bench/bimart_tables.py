"""BimArt compared with its baselines on one dataset (its Tables 1 and 3): train, sample and measure every method.

``python -m bench bimart-tables`` in a project. HOIDATA_BENCH_DATA: a folder with clips, annotation, contact and splits
(data/embedded/arctic); HOIDATA_BENCH_SIZE: small or full, as in params.yaml; HOIDATA_BENCH_SAMPLES: motions per clip
(4); HOIDATA_BENCH_CLIPS: test clips or windows, 0 for all (16); HOIDATA_BENCH_SEED: of all random numbers (0);
HOIDATA_BENCH_STEPS: training steps instead of those of the size; HOIDATA_BENCH_METHODS: names of methods with commas.

HOIDATA_BENCH_WINDOWS=1 measures windows of whole test clips as BimArt's release does. The release's dataset is ARCTIC
converted with ``clips: whole`` and the split ``bimart-released``. Networks, motions and metrics are stored in
HOIDATA_BENCH_OUT (.hoidata/bimart-tables): a killed run continues. Delete the folder after a change of code or data.

The nearest training window, refined as ours, is the retrieval baseline. Every method is given which hands act in the
recording. Only CAMS-B is also conditioned on recorded hands: those of the first frame, and when each hand touches
which part.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from bench.bimart_baselines import CAMS_B, MDM_B, OMOMO_B
from hoidata.files import write_whole
from hoidata.files.atomic import canonical_json
from hoidata.files.written import read_json
from hoidata.hands import HandPair
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.optional_metrics import select_metrics
from hoidata.settings import build_config
from hoidata.store.annotated import WindowProtocol
from models.common.checkpoints import FILE_NAME
from models.common.family import Family, Network
from models.common.predicting import sample_family
from models.common.repeatable import chosen_device, make_repeatable
from models.common.training import train_network
from models.registry import load_family
from pipelines.params import read_params
from pipelines.stages.base import load_hands
from pipelines.stages.train import TrainParams

BASELINE_TRAINING = {
    "small": {"steps": 2000, "batch": 16, "learning_rate": 1e-3, "warmup": 50, "ema_decay": 0.99},
    "full": {"steps": 100_000, "batch": 64, "learning_rate": 2e-4, "warmup": 500, "ema_decay": 0.999},
}
# Per definition: column and its metric.
TABLES = {
    "as released": {
        "Mul, cm": "bimart_mul_cm",
        "Accel, cm/frame2": "bimart_accel_paper",
        "Pen 1 cm, %": "bimart_pen_1cm_paper",
        "Pen 5 mm, %": "bimart_pen_5mm_paper",
        "Con, %": "bimart_con_paper",
        "Art, %": "bimart_art_paper",
        "CM, cm": "bimart_cm_paper",
    },
    "corrected": {
        "Accel, m/s2": "bimart_accel_corrected",
        "Pen 1 cm, %": "bimart_pen_1cm_corrected",
        "Pen 5 mm, %": "bimart_pen_5mm_corrected",
        "Con, %": "bimart_con_corrected",
        "Art, %": "bimart_art_corrected",
        "CM, cm": "bimart_cm_corrected",
        "contact F1": "contact_f1",
        "joints, best, mm": "joint_error_mm",
    },
}


@dataclass(frozen=True)
class Method:
    """A method of the table."""

    title: str
    load: Callable[[], Family]
    preset: str = ""  # of BimArt's networks and sampling
    samples: int | None = None  # motions per clip; None: those of the run
    settings: Mapping[str, Any] = field(default_factory=dict)  # changes to the section ``sample.bimart``


def _of_registry(name: str) -> Callable[[], Family]:
    return lambda: load_family(name)


def _step(title: str, **settings: Any) -> Method:
    """A row of Table 3: preset paper without its last steps."""
    return Method(f"BimArt, paper: {title}", _of_registry("bimart"), "paper", settings=settings)


METHODS = {
    "ground-truth": Method("recorded clips", _of_registry("ground-truth"), samples=1),
    "nearest-window": Method("nearest training window", _of_registry("nearest-window"), samples=1),
    "nearest-window-refined": Method("the same, refined", _of_registry("nearest-window-refined"), samples=1),
    "mean-pose": Method("mean pose at the object", _of_registry("mean-pose-at-object"), samples=1),
    "hands-shifted": Method("recorded, hands shifted by 3 cm", _of_registry("hands-shifted"), samples=1),
    "pressed-deep": Method("recorded, hands pressed in by 3 cm", _of_registry("pressed-deep"), samples=1),
    "cams-b": Method(CAMS_B.title, lambda: CAMS_B),
    "mdm-b": Method(MDM_B.title, lambda: MDM_B),
    "omomo-b": Method(OMOMO_B.title, lambda: OMOMO_B),
    # The usual rule with weight -1 is the network without a contact map.
    "paper-without-contact": _step(
        "without contact maps",
        refinement="none",
        sampling={"sampler": {"guidance": -1.0}, "guidance_rule": "usual", "contact_guidance": "off"},
    ),
    "paper-with-contact": _step("with maps", refinement="none", sampling={"contact_guidance": "off"}),
    "paper-guided": _step("and contact guidance", refinement="none"),
    "paper": Method("BimArt, paper", _of_registry("bimart"), "paper"),
    "ours-unrefined": Method("BimArt, ours, before refinement", _of_registry("bimart-unrefined"), "ours"),
    "ours": Method("BimArt, ours", _of_registry("bimart"), "ours"),
}


@dataclass(frozen=True)
class Run:
    """One run of the comparison."""

    data: Path  # an annotated dataset
    out: Path  # folder of networks, motions and metrics
    hands: HandPair
    train: TrainParams  # section ``train`` of params.yaml
    baselines: Mapping[str, Any]  # section ``training`` of the baselines' networks
    settings: Mapping[str, Any] = field(default_factory=dict)  # section ``sample.bimart``
    samples: int = 4  # motions per clip
    clips: int = 16  # test clips or windows; 0: all
    seed: int = 0
    steps: int = 0  # of training; 0: as the sections say
    windows: WindowProtocol | None = None
    device: str = "cpu"

    def evaluate(self, name: str) -> dict[str, Any]:
        """Train, sample and measure a method, unless its metrics exist.

        Returns:
            The result of ``evaluate_store`` with the processor seconds per motion of sampling and of evaluation, or the
            reason under ``empty``.
        """
        method, folder, path = METHODS[name], self.out / "motions" / name, self.out / "metrics" / f"{name}.json"
        if path.is_file():
            return read_json(path)
        family = replace(method.load(), name=name, diagnose=lambda sources: {})
        networks = self.out / "networks" / (method.preset or "baselines")
        bimart_networks = [network for network in load_family("bimart").networks if network.name in family.uses]
        for network in family.networks or bimart_networks:
            self._train(network, networks, method.preset)
        options = {"samples": method.samples or self.samples, "seed": self.seed, "clips": self.clips}
        options |= {"windows": asdict(self.windows)} if self.windows else {}
        settings, start_s = {"bimart": {**self.settings, **method.settings}}, time.process_time()
        counts = sample_family(
            family,
            self.data,
            networks,
            folder,
            options,
            self.hands,
            settings=settings,
            device=self.device,
        )
        if not counts["clips"]:
            return read_json(folder / "empty.json")
        sampled_s = time.process_time()
        shown = {name for columns in TABLES.values() for name in columns.values()}
        metrics = tuple(metric for metric in select_metrics(["bimart"]) if metric.name in shown)
        result = evaluate_store(folder / "clips", self.data, self.hands, metrics=metrics)
        seconds = sampled_s - start_s, time.process_time() - sampled_s
        result["seconds"] = [part / result["motions"] for part in seconds]
        write_whole(path, canonical_json(result))
        return result

    def _train(self, network: Network, folder: Path, preset: str) -> None:
        if (folder / network.name / FILE_NAME).is_file():
            return
        params = replace(self.train, preset=preset).of(network.name) if preset else {"training": self.baselines}
        if self.steps:
            params = {**params, "training": {**params["training"], "steps": self.steps}}
        params = {**params, "seed": self.seed}
        progress = folder / f"{network.name}-progress"
        train_network(
            network, self.data, folder / network.name, params, self.hands, device=self.device, progress=progress
        )


def rows(run: Run, names: Sequence[str], columns: Sequence[str]) -> list[list[str]]:
    """The table: per method its title, motions, measured of all clips, seconds per motion, and a cell per metric."""
    table = []
    for name in names:
        result = run.evaluate(name)
        counts = str(result.get("empty"))
        if "motions" in result:
            clips = result["counts"]["joint_error_mm"]["clips"]
            counts = f"{result['motions']} in {clips} of {result['held_out_clips']}"
        seconds = " + ".join(_cell(value) for value in result.get("seconds", [None]))
        table.append([METHODS[name].title, counts, seconds, *(_metric(result, metric) for metric in columns)])
    return table


def _metric(result: Mapping[str, Any], name: str) -> str:
    """The value, and its 95 % interval over sequences if there is one."""
    interval = result.get("intervals", {}).get(name, {}).get("clips")
    ends = "" if interval is None else f" [{_cell(interval[0])}, {_cell(interval[1])}]"
    return _cell(result.get("figures", {}).get(name)) + ends


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def main() -> None:
    make_repeatable(threads=1)
    variables = {name: os.environ.get(f"HOIDATA_BENCH_{name}", "") for name in ("DATA", "OUT", "SIZE", "METHODS")}
    options = {name: os.environ.get(f"HOIDATA_BENCH_{name.upper()}") for name in ("samples", "clips", "seed", "steps")}
    numbers: dict[str, Any] = {name: int(value) for name, value in options.items() if value}
    data, params = Path(variables["DATA"] or "data/embedded/arctic"), read_params(Path())
    size = variables["SIZE"] or params["train"]["size"]
    run = Run(
        data=data,
        out=Path(variables["OUT"] or ".hoidata/bimart-tables"),
        hands=load_hands(data.parent.name),
        train=build_config(TrainParams, {**params["train"], "size": size}, "params.yaml: train"),
        baselines=BASELINE_TRAINING[size],
        windows=WindowProtocol() if os.environ.get("HOIDATA_BENCH_WINDOWS") else None,
        device=chosen_device(params.get("device", "auto")),
        **numbers,
    )
    names = variables["METHODS"].split(",") if variables["METHODS"] else list(METHODS)
    for definition, columns in TABLES.items():
        titles = ["method", "motions in clips", "s per motion: sample + measure", *columns]
        table = [titles, ["---"] * len(titles), *rows(run, names, list(columns.values()))]
        print(f"\n{size} networks, {definition}, 95 % intervals over sequences\n")
        print("\n".join(f"| {' | '.join(cells)} |" for cells in table), flush=True)
