"""Samples a family's motions for a dataset's test clips, and writes them as a store of clips."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request, Sentence, Trajectories
from hoidata.clips.clip import Clip
from hoidata.clips.features import GLOBAL_ORIENT_6D
from hoidata.files import atomic_folder, write_whole
from hoidata.hands import HandPair
from hoidata.metrics.target_contact import TargetDistances, write_target_contact, write_target_distances
from hoidata.settings import build_config, require_at_least
from hoidata.store.annotated import WindowedStore, WindowProtocol, load_annotated
from hoidata.store.store import write_store
from models.common.checkpoints import FILE_NAME, empty_reason, write_empty
from models.common.family import Family, ReportsContact, Sampler, Skipped, Sources
from models.common.repeatable import seed_of

CLIPS_AT_ONCE = 32
LEFT_OUT = "left_out.json"
Item = TypeVar("Item")
Contact = np.ndarray | TargetDistances  # that a motion is conditioned on


@dataclass(frozen=True)
class PredictionConfig:
    """How many motions are sampled."""

    samples: int = 8  # per test clip
    seed: int = 0  # of all random numbers
    clips: int = 0  # evenly spaced test clips, or windows; 0: all
    windows: WindowProtocol | None = None  # windows of the test clips instead of their first frames

    def __post_init__(self) -> None:
        require_at_least("sample", self, "samples", 1)
        require_at_least("sample", self, "clips", 0)


def sample_family(
    family: Family,
    annotated_root: str | Path,
    checkpoints: str | Path,
    out: str | Path,
    params: Mapping[str, Any],
    hands: HandPair,
    *,
    settings: Mapping[str, Any] | None = None,
    encoder: str = "",
    device: str = "cpu",
) -> dict[str, int]:
    """Sample a family's motions for the test clips.

    Writes ``out/clips`` and ``out/diagnostics.json``, or ``out/empty.json`` with the reason. Skipped requests are
    listed in ``out/left_out.json``. A family that is :class:`ReportsContact` also gets ``out/asked.npz`` or
    ``out/asked-distances.npz`` (``hoidata.metrics.target_contact``). Motion k for a clip is named ``<clip id>~<k>``.
    Length and hand type are those of the recorded clip, unless the family estimates them; of a clip that is too long,
    the first frames count.

    Args:
        annotated_root: folder with clips, annotation, contact and splits of a dataset.
        checkpoints: folder with one checkpoint folder per network.
        settings: section of params.yaml by family.
        encoder: name of the text encoder, for families that read sentences; "": the one that the annotation names.

    Returns counts of the store.
    """
    config = build_config(PredictionConfig, params, "params.yaml: sample")
    root, checkpoints = Path(annotated_root), Path(checkpoints)
    reason = _why_not(family, root, checkpoints)
    annotated = None if reason else load_annotated(root, hands)
    if annotated and config.windows:
        annotated = WindowedStore(annotated, config.windows)
    test = [] if annotated is None else list(HoiDataset(annotated, "test", crop="start"))
    test = spread(test, config.clips)
    if annotated is None or not test:
        with atomic_folder(out) as partial:
            write_empty(partial, reason or "no test clips")
        return {"clips": 0}
    sources = Sources(annotated, checkpoints, hands, torch.device(device), settings or {}, encoder)
    with atomic_folder(out) as partial:
        info = annotated.info | {"family": family.name, "sampling_device": sources.device.type}
        info |= {"length": "own"} if family.estimates_length else {}
        info |= {"windows": asdict(config.windows)} if config.windows else {}
        left_out, contacts = list[Skipped](), dict[str, Contact]()
        motions = _motions(family.load(sources), test, config, left_out, contacts)
        first = next(motions, None)
        if first is None:
            write_empty(partial, f"no motion of {len(left_out)}: {left_out[0].reason}")
            return {"clips": 0}
        counts = write_store(partial / "clips", chain([first], motions), info)
        _write_asked(partial, contacts)
        _write(partial / "diagnostics.json", family.diagnose(sources))
        if left_out:
            _write(partial / LEFT_OUT, [asdict(item) for item in left_out])
    return counts


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """``count`` evenly spaced items; all if there are fewer, or for 0."""
    count = min(count or len(items), len(items))
    return [items[number * len(items) // count] for number in range(count)]


def requests_for(sample: ClipSample, config: PredictionConfig) -> list[Request]:
    """Requests for ``config.samples`` motions in place of a recorded clip; seeds do not depend on other clips."""
    trajectories = Trajectories(sample.hands[..., : GLOBAL_ORIENT_6D.stop], sample.valid, sample.object)
    return [
        Request(
            motion_id=f"{sample.clip_id}~{number}",
            object=sample.object_model,
            points=sample.points,
            text=sample.text[0],
            active_hands=sample.active_hands,
            n_frames=sample.length,
            seed=seed_of(f"{config.seed} {number} {sample.clip_id}"),
            number=number,
            clip_id=sample.clip_id,
            object_words=sample.object_words,
            sentence=first_sentence(sample),
            betas=sample.betas,
            template_m=sample.template_m,
            world_from_model=sample.world_from_model,
            gravity_known=sample.gravity_known,
            trajectories=trajectories,
        )
        for number in range(config.samples)
    ]


def first_sentence(sample: ClipSample) -> Sentence:
    """The first sentence of a clip, an imperative."""
    return Sentence(sample.sentences[0], sample.verb, sample.object_words or None)


def _write_asked(folder: Path, contacts: Mapping[str, Contact]) -> None:
    """Write the contact conditions, each kind to its file, if there are any."""
    distances = {name: contact for name, contact in contacts.items() if isinstance(contact, TargetDistances)}
    if touched := {name: contact for name, contact in contacts.items() if isinstance(contact, np.ndarray)}:
        write_target_contact(folder, touched)
    if distances:
        write_target_distances(folder, distances)


def _write(path: Path, values: Any) -> None:
    write_whole(path, json.dumps(values, indent=2, sort_keys=True) + "\n")


def _motions(
    sampler: Sampler,
    test: Sequence[ClipSample],
    config: PredictionConfig,
    left_out: list[Skipped],
    contacts: dict[str, Contact],
) -> Iterator[Clip]:
    """The motions in order; adds skipped requests to ``left_out``, and reported contact conditions to ``contacts``."""
    starts = range(0, len(test), CLIPS_AT_ONCE)
    for start in track(starts, description="sampling", transient=True, console=Console(stderr=True)):
        chosen = test[start : start + CLIPS_AT_ONCE]
        requests = [request for sample in chosen for request in requests_for(sample, config)]
        if isinstance(sampler, ReportsContact):
            answers, maps = sampler.sample_with_targets(requests)
            pairs = zip(answers, maps, strict=True)
            contacts |= {answer.clip_id: contact for answer, contact in pairs if contact is not None}
        else:
            answers = sampler.sample(requests)
        left_out += [answer for answer in answers if isinstance(answer, Skipped)]
        yield from (answer for answer in answers if isinstance(answer, Clip))


def _why_not(family: Family, root: Path, checkpoints: Path) -> str | None:
    """The reason why nothing can be sampled: an empty dataset, or a missing network."""
    folders = [root / "clips", root / "annotation", root / "contact", *(checkpoints / name for name in family.uses)]
    if reason := next(filter(None, map(empty_reason, folders)), None):
        return reason
    absent = [name for name in family.uses if not (checkpoints / name / FILE_NAME).is_file()]
    return f"not trained: {', '.join(absent)}" if absent else None
