"""The motions of a family for a dataset's test clips, written as an ordinary store of clips."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from rich.progress import track

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import Clip
from hoidata.files import atomic_folder
from hoidata.hands import HandPair
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
        counts = write_store(partial / "clips", _motions(family.load(sources), test, config), info)
        figures = json.dumps(family.diagnose(sources), indent=2, sort_keys=True)
        (partial / "diagnostics.json").write_text(figures + "\n")
    return counts


def requests_for(sample: ClipSample, config: PredictionConfig) -> list[Request]:
    """What is asked of a family in place of a recorded clip: as often as the config says, each with its own seed.

    A motion's seed does not depend on which other clips there are.
    """
    return [
        Request(
            motion_id=f"{sample.clip_id}~{number}",
            object=sample.object_model,
            points=sample.points,
            text=sample.text[0],
            active_hands=sample.active_hands,
            n_frames=sample.length,
            seed=int.from_bytes(sha256(f"{config.seed} {number} {sample.clip_id}".encode()).digest()[:7]),
            number=number,
            clip_id=sample.clip_id,
            object_words=sample.object_words,
            betas=sample.betas,
            template_m=sample.template_m,
            world_from_model=sample.world_from_model,
        )
        for number in range(config.samples)
    ]


def _motions(sampler: Sampler, test: Sequence[ClipSample], config: PredictionConfig) -> Iterator[Clip]:
    starts = range(0, len(test), CLIPS_AT_ONCE)
    for start in track(starts, description="sampling", transient=True):
        requests = [asked for sample in test[start : start + CLIPS_AT_ONCE] for asked in requests_for(sample, config)]
        yield from sampler.sample(requests)


def _why_not(family: Family, root: Path, checkpoints: Path) -> str | None:
    """What is missing: an empty dataset, or a network the family uses."""
    folders = [root / "clips", root / "annotation", root / "contact", *(checkpoints / name for name in family.uses)]
    if reason := next(filter(None, map(empty_reason, folders)), None):
        return reason
    absent = [name for name in family.uses if not (checkpoints / name / FILE_NAME).is_file()]
    return f"not trained: {', '.join(absent)}" if absent else None
