"""What every switch of Text2HOI's preset `ours` is worth: trained without it, at equal steps, with the spread of seeds.

``python -m bench ablation`` in a project. HOIDATA_BENCH_DATA: a folder with clips, annotation, contact and splits
(data/embedded/grab); HOIDATA_BENCH_STEPS: of every diffusion network (320); HOIDATA_BENCH_SEEDS: trainings of each row
(3); HOIDATA_BENCH_ROWS: some rows alone, by name with commas; HOIDATA_BENCH_MINUTES: no row is begun later than that
(120). Sizes and all other settings are those of params.yaml, size `small`. What was computed is kept in
.hoidata/ablation and taken up again while data, settings and code are the same: a run may be stopped at any time, and
several started side by side share the rows. On `study` so few teach nothing (`ours` does what the verb says in .05):
take 1,200 or more there.

Rows of `ours` are held, `paper` and `released` have their own refiner. Rows under `paper` are those of the paper's
Tables 2 and S1, a refiner that is a diffusion model. The last rows of `ours` change how its motions are made alone.
"""

import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from bench.harness import show
from hoidata.files import write_whole
from hoidata.files.atomic import atomic_folder
from hoidata.hands import load_embedded_hands
from hoidata.metrics.evaluate import evaluate_store
from hoidata.metrics.registry import METRICS
from hoidata.settings import build_config
from models.common.checkpoints import FILE_NAME, load_checkpoint
from models.common.family import Family, Sources
from models.common.features import Hands
from models.common.predicting import sample_family
from models.common.repeatable import make_repeatable
from models.common.training import train_network
from models.registry import load_network
from models.text2hoi.family import encoder_of
from models.text2hoi.sampler import SamplingConfig, Text2Hoi
from models.text2hoi.understanding import Teller
from pipelines.lineage.digests import path_digest, value_digest
from pipelines.params import laid_over, read_params
from pipelines.stages.tables import mean_and_spread

KEPT = Path(".hoidata/ablation")
CODE = ("bench/ablation.py", "models/common", "models/text2hoi", "hoidata")
CLIPS, SAMPLES = 96, 2
Settings = Mapping[str, Any]
COLUMNS = {
    "action_followed": "followed",
    "action_named": "named",
    "contact_f1": "contact F1",
    "adherence": "adherence",
    "deep_share": "deep",
    "realism_si": "realism",
    "slip_cm_s": "slip cm/s",
    "jitter_m_s3": "jitter m/s3",
    "joint_error_mm": "joints mm",
}


@dataclass(frozen=True)
class Row:
    """The preset of all networks, by network what is laid over its settings, and what over ``sample.text2hoi``."""

    preset: Literal["ours", "paper", "released"] = "ours"
    changed: Mapping[str, Settings] = field(default_factory=dict)
    sampled: Settings = field(default_factory=dict)

    @property
    def networks(self) -> tuple[str, ...]:
        """What is trained, in this order; lengths are the clips' own."""
        return ("contact", "diffusion") if self.preset == "ours" else ("contact", "diffusion", "refiner")

    def settings(self, train: Settings, network: str) -> Settings:
        """Of one network by the section ``train`` of params.yaml, without steps and seed."""
        own, small = (train[name].get(network, {}) for name in (self.preset, "small"))
        return laid_over(laid_over(own, small), self.changed.get(network, {}))

    def sampling(self) -> SamplingConfig:
        """How its motions are made: ours are held, the others have their own refiner."""
        refined_by = {"refined_by": "hold" if self.preset == "ours" else "network"}
        return build_config(SamplingConfig, laid_over(refined_by, self.sampled), "bench: ablation")


def _network(**changed: Any) -> Row:
    return Row(changed={"diffusion": {"network": changed}})


def _motion(**changed: Any) -> Row:
    return _network(motion=changed)


def _loss(preset: Literal["ours", "paper"] = "ours", **changed: Any) -> Row:
    return Row(preset, {"diffusion": {"loss": changed}})


# One switch each, set as the paper has it, or otherwise where the name says so; what cannot stand with it goes too.
LESS: Mapping[str, Row] = {
    "no splines": _motion(knot_frames=0, object_knots=1),
    "as many knots of the object": _motion(object_knots=1),
    "hands in the world": _motion(hand_frame="world"),
    "place of the object's origin": _motion(object_place="origin"),
    "rotation of the object as it is": _motion(object_turn="absolute"),
    "rows not whitened": _motion(whitening_frames=0),
    "rest as generated": _motion(rest_m=0),
    "norm after each half": _network(transformer={"norm_first": False, "modulated": False}),
    "a token a frame": _network(transformer={"frames_per_token": 1}),
    "blocks not modulated": _network(transformer={"modulated": False}),
    "no gate": _network(input_gate=False),
    "not normalised": _network(normalised=False),
    "hands and length not told": _network(told=False),
    "contact as a map": _network(contact_input="map", object_dropout=0.0),
    "features of the sentence": _network(text_input="linear"),
    "object's feature never told": _network(object_feature=False),
    "object's feature always told": _network(object_dropout=0.0),
    "object's size told": _network(scale_input=True, object_dropout=0.0),
    "condition in its own token": _network(condition_everywhere=False),
    "end not told": _network(frames_to_go=False),
    "signal as large as noise": _network(signal_scale=1.0),
    "constant learning rate": Row(changed={"diffusion": {"training": {"schedule": "constant"}}}),
    "with augmented copies": Row(changed={"diffusion": {"training": {"augmented_copies": 8}}}),
    "gradients not clipped": Row(changed={"diffusion": {"training": {"clip_norm": 0.0}}}),
    "contact drawn in training": _loss(contact="estimated"),
    "with eq. 6": _loss(distance_weight=1.0),
    "with eq. 7": _loss(orientation_weight=1.0),
    "sum over all numbers": _loss(weighting="sum"),
    "no loss of velocity": _loss(velocity_weight=0.0),
    "no loss of joints": _loss(joint_weight=0.0),
    "all touched points": _loss(thin_contact=False),
    "contact by a latent": Row(changed={"contact": {"network": {"drawn_by": "latent"}}}),
    "contact at a constant rate": Row(changed={"contact": {"training": {"schedule": "constant"}}}),
    "contact of the last step": Row(changed={"contact": {"training": {"keep_best": False}}}),
    # What is done when motions are made, by the networks of `ours`.
    "the first contact map drawn": Row(sampled={"contact_draws": 1}),
    "a motion drawn once": Row(sampled={"draws": 1}),
    "an object that never waits": Row(sampled={"hold": {"wait": {"most": 0}}}),
    "grasps as generated": Row(sampled={"hold": {"regrasp": {"tries": 0}}}),
    "fingers free in the hold": Row(sampled={"hold": {"solver": {"finger_rad": 100.0}}}),
}
PAPERS: Mapping[str, Row] = {
    "paper: no codes": Row("paper", {"diffusion": {"network": {"codes": "none"}}}),
    "paper: codes of frames alone": Row("paper", {"diffusion": {"network": {"codes": "frames"}}}),
    "paper: no eq. 6": _loss("paper", distance_weight=0.0),
    "paper: no eq. 7": _loss("paper", orientation_weight=0.0),
    "paper: no contact": Row("paper", {"diffusion": {"network": {"contact_input": "none"}}}),
    "paper: no scale": Row("paper", {"diffusion": {"network": {"scale_input": False}}}),
    "paper: no eq. 10": Row("paper", {"refiner": {"loss": {"penetration_weight": 0.0}}}),
    "paper: no eq. 11": Row("paper", {"refiner": {"loss": {"contact_weight": 0.0}}}),
    # The paper does not say how far the diffusion refiner noises.
    "paper: a diffusion refiner": Row("paper", {"refiner": {"network": {"noise_steps": 500}}}),
}
ROWS: Mapping[str, Row] = {"ours": Row(), "paper": Row("paper"), "released": Row("released"), **LESS, **PAPERS}


@dataclass(frozen=True)
class Study:
    """One dataset and budget. train: that section of params.yaml. made_from: a digest of data, code and budget."""

    data: Path
    steps: int
    train: Settings
    made_from: str

    @classmethod
    def here(cls) -> "Study":
        """As the environment says, in the current project."""
        data = Path(os.environ.get("HOIDATA_BENCH_DATA", "data/embedded/grab"))
        steps, root = int(os.environ.get("HOIDATA_BENCH_STEPS", "320")), Path(__file__).parents[1]
        read = [data / name for name in ("clips", "annotation", "contact", "splits")]
        made_from = value_digest([*(path_digest(path) for path in (*read, *(root / name for name in CODE)))])
        return cls(data, steps, read_params(Path())["train"], made_from)

    def settings(self, row: Row, network: str, seed: int) -> dict[str, Any]:
        """All settings of one training."""
        budget = {"training": {"steps": self.steps}} if network == "diffusion" else {}
        return {**laid_over(row.settings(self.train, network), budget), "seed": seed}

    def trained(self, row: Row, network: str, seed: int) -> Path:
        """The folder of one network, trained now, or before for this or another row."""
        needed = {name: self.trained(row, name, seed) for name in load_network(network).needs}
        settings = self.settings(row, network, seed)
        # A diffusion network that is shown recorded contact maps learns nothing from the contact network.
        heard = [] if settings.get("loss", {}).get("contact") == "recorded" else [path.name for path in needed.values()]
        asked = value_digest([self.made_from, network, settings, heard])
        folder = KEPT / f"{network}-{asked[:16]}"
        with FileLock(f"{folder}.lock"):
            if not (folder / FILE_NAME).is_file():
                with atomic_folder(folder) as partial:
                    folders = {load_network(name): path for name, path in needed.items()}
                    train_network(load_network(network), self.data, partial, settings, needed=folders)
        return folder

    def figures_path(self, row: Row, seed: int) -> Path:
        """Where a row's figures are kept."""
        settings = [self.settings(row, network, seed) for network in row.networks]
        return KEPT / f"row-{value_digest([self.made_from, row.preset, settings, row.sampled])[:16]}.json"

    def figures(self, row: Row, seed: int) -> dict[str, float]:
        """What is measured of a row's motions for evenly spread test clips."""
        folders = {name: self.trained(row, name, seed) for name in row.networks}
        hands, wanted = load_embedded_hands(), tuple(metric for metric in METRICS if metric.name in COLUMNS)
        family = Family("ablation", "A row", lambda sources: _answering(sources, folders, row))
        with tempfile.TemporaryDirectory() as folder:
            sample_family(family, self.data, folder, Path(folder) / "out", {"samples": SAMPLES, "clips": CLIPS}, hands)
            return evaluate_store(Path(folder) / "out/clips", self.data, hands, metrics=wanted)["figures"]


def _answering(sources: Sources, folders: Mapping[str, Path], row: Row) -> Text2Hoi:
    """The row's networks, ready to answer; a refiner that nothing asks is not among them."""
    trained = {name: load_checkpoint(path, load_network(name), sources.device) for name, path in folders.items()}
    encoder = encoder_of(sources)
    return Text2Hoi(
        trained,
        Hands(sources.hands).to(sources.device),
        row.sampling(),
        sources.device,
        sources.hands,
        None if encoder is None else Teller.of(trained, encoder),
    )


def main() -> None:
    study, wanted = Study.here(), os.environ.get("HOIDATA_BENCH_ROWS", ",".join(ROWS)).split(",")
    if not (study.data / "clips").is_dir():
        print(f"{study.data}: no clips; run `hoidata repro` first, or name a folder in HOIDATA_BENCH_DATA")
        return
    if unknown := sorted(set(wanted) - set(ROWS)):
        print(f"no row {', '.join(unknown)}; there are {', '.join(ROWS)}")
        return
    make_repeatable(threads=1)
    KEPT.mkdir(parents=True, exist_ok=True)
    seeds = range(int(os.environ.get("HOIDATA_BENCH_SEEDS", "3")))
    left_out = fill(study, [(name, seed) for seed in seeds for name in wanted])
    show_rows(study, wanted, seeds)
    if left_out:
        print(f"not made, for want of time or because another run makes them: {', '.join(left_out)}")


def fill(study: Study, jobs: Sequence[tuple[str, int]]) -> list[str]:
    """Measure row after row, leaving to another run what it has begun; those that are not there in the end."""
    end = time.monotonic() + 60 * float(os.environ.get("HOIDATA_BENCH_MINUTES", "120"))
    for name, seed in jobs:
        path, began = study.figures_path(ROWS[name], seed), time.monotonic()
        with suppress(Timeout), FileLock(path.with_suffix(".lock"), timeout=0):
            if not path.is_file() and began < end:
                write_whole(path, json.dumps(study.figures(ROWS[name], seed), indent=1))
                print(f"{name}, seed {seed}: {time.monotonic() - began:.0f} s", flush=True)
    return [f"{name} {seed}" for name, seed in jobs if not study.figures_path(ROWS[name], seed).is_file()]


def show_rows(study: Study, names: Sequence[str], seeds: Sequence[int]) -> None:
    """One line per row: how many seeds, parameters, and of each figure the mean and the spread over seeds."""
    lines = []
    for name in names:
        paths = [study.figures_path(ROWS[name], seed) for seed in seeds]
        found = [json.loads(path.read_text()) for path in paths if path.is_file()]
        cells = [mean_and_spread(one.get(key) for one in found) for key in COLUMNS]
        lines.append([name, str(len(found)), f"{parameters(study.train, ROWS[name]):,}", *cells])
    title = f"{study.data}, {study.steps} steps, {CLIPS} clips at most, {SAMPLES} motions each"
    show(title, ["row", "seeds", "parameters", *COLUMNS.values()], lines)


def parameters(train: Settings, row: Row) -> int:
    """That the row's diffusion network learns; the point network it sees with is the contact network's."""
    contact, own = (
        build_config(load_network(name).config, row.settings(train, name).get("network", {}), "params.yaml: train")
        for name in ("contact", "diffusion")
    )
    built = load_network("diffusion").build(replace(own, point_net=contact.point_net))
    return sum(weight.numel() for weight in built.parameters() if weight.requires_grad)


if __name__ == "__main__":
    main()
