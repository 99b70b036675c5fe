"""The motions of a family for a dataset's test clips, written as an ordinary store of clips."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from rich.progress import track

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.files import atomic_file, atomic_folder
from hoidata.hands import HandPair
from hoidata.metrics.asked import write_asked
from hoidata.settings import build_config
from hoidata.store.annotated import load_annotated
from hoidata.store.store import write_store
from models.common.checkpoints import FILE_NAME, empty_reason, write_empty
from models.common.family import Family, Sampler, Sources

CLIPS_AT_ONCE = 32


@dataclass(frozen=True)
class PredictionConfig:
    """samples: motions for every test clip. seed: of all that is drawn."""

    samples: int = 8
    seed: int = 0


@runtime_checkable
class AsksContact(Protocol):
    """A family ready to answer that decides where the object is to be touched, and can say so."""

    def sample_asked(self, requests: Sequence[Request]) -> tuple[list[Clip], list[np.ndarray]]:
        """As ``Sampler.sample``, and (point,) bool of each motion: the sampled points it was asked to touch."""
        ...


def sample_family(
    family: Family,
    annotated_root: str | Path,
    checkpoints: str | Path,
    out: str | Path,
    params: Mapping[str, Any],
    hands: HandPair,
    *,
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
) -> dict[str, int]:
    """Write ``out/clips`` and ``out/diagnostics.json``, or ``out/empty.json`` with the reason; the counts.

    A family that is :class:`AsksContact` also gets ``out/asked.npz`` (``hoidata.metrics.asked``).
    annotated_root: clips, annotation, contact and splits of a dataset. checkpoints: folder with one per network.
    params: a :class:`PredictionConfig`; settings: sections of families, by name. The k-th motion for a clip is named
    ``<clip id>~<k>``; lengths and acting hands are the clip's own, of clips longer than a model takes the first frames.
    """
    config = build_config(PredictionConfig, params, "params.yaml: sample")
    root, checkpoints = Path(annotated_root), Path(checkpoints)
    reason = _why_not(family, root, checkpoints)
    annotated = None if reason else load_annotated(root, hands)
    test = [] if annotated is None else list(HoiDataset(annotated, "test", crop="start"))
    if annotated is None or not test:
        with atomic_folder(out) as partial:
            write_empty(partial, reason or "no test clips")
        return {"clips": 0}
    sources = Sources(annotated, checkpoints, hands, torch.device(device), settings or {})
    with atomic_folder(out) as partial:
        info = annotated.info | {"family": family.name, "sampling_device": sources.device.type}
        asked = dict[str, np.ndarray]()
        counts = write_store(partial / "clips", _motions(family.load(sources), test, config, asked), info)
        if asked:
            write_asked(partial, asked)
        with atomic_file(partial / "diagnostics.json") as file:
            file.write_text(json.dumps(family.diagnose(sources), indent=2, sort_keys=True) + "\n")
    return counts


def requests_for(sample: ClipSample, config: PredictionConfig) -> list[Request]:
    """What is asked of a family in place of a recorded clip: as often as the config says, each with its own seed."""
    return [
        Request(
            motion_id=f"{sample.clip_id}~{number}",
            object=sample.object_model,
            points=sample.points,
            text=sample.text[0],
            active_hands=sample.active_hands,
            n_frames=sample.length,
            seed=_seed(config.seed, sample.clip_id, number),
            number=number,
            clip_id=sample.clip_id,
            object_words=sample.object_words,
            betas=sample.betas,
            template_m=sample.template_m,
            world_from_model=sample.world_from_model,
        )
        for number in range(config.samples)
    ]


def _motions(
    sampler: Sampler, test: Sequence[ClipSample], config: PredictionConfig, asked: dict[str, np.ndarray]
) -> Iterator[Clip]:
    """The clips in order; ``asked`` is filled with the contact map of each, where the family has them."""
    starts = range(0, len(test), CLIPS_AT_ONCE)
    for start in track(starts, description="sampling", transient=True):
        chosen = test[start : start + CLIPS_AT_ONCE]
        requests = [request for sample in chosen for request in requests_for(sample, config)]
        if isinstance(sampler, AsksContact):
            clips, maps = sampler.sample_asked(requests)
            asked |= {clip.clip_id: contact_map for clip, contact_map in zip(clips, maps, strict=True)}
        else:
            clips = sampler.sample(requests)
        yield from clips


def _seed(seed: int, clip_id: str, number: int) -> int:
    """A seed for one motion that does not depend on which other clips there are."""
    return int.from_bytes(hashlib.sha256(f"{seed} {number} {clip_id}".encode()).digest()[:7])


def _why_not(family: Family, root: Path, checkpoints: Path) -> str | None:
    """What is missing: an empty dataset, or a network the family uses."""
    folders = [root / name for name in ("clips", "annotation", "contact")] + [
        checkpoints / name for name in family.uses
    ]
    if reason := next((reason for folder in folders if (reason := empty_reason(folder))), None):
        return reason
    absent = [name for name in family.uses if not (checkpoints / name / FILE_NAME).is_file()]
    return f"not trained: {', '.join(absent)}" if absent else None
