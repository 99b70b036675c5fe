"""The motions of a family for a dataset's test clips, written as an ordinary store of clips."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from rich.progress import track

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request, Sentence, Trajectories
from hoidata.clips.clip import Clip
from hoidata.clips.features import GLOBAL_ORIENT_6D
from hoidata.files import atomic_folder, write_whole
from hoidata.hands import HandPair
from hoidata.metrics.asked import AskedDistances, write_asked, write_asked_distances
from hoidata.settings import at_least, build_config
from hoidata.store.annotated import load_annotated
from hoidata.store.store import write_store
from models.common.checkpoints import FILE_NAME, empty_reason, write_empty
from models.common.family import Family, LeftOut, Sampler, Sources

CLIPS_AT_ONCE = 32
LEFT_OUT = "left_out.json"
Item = TypeVar("Item")


@dataclass(frozen=True)
class PredictionConfig:
    """samples: motions for every test clip. seed: of all that is drawn. clips: evenly spread test clips; 0: all."""

    samples: int = 8
    seed: int = 0
    clips: int = 0

    def __post_init__(self) -> None:
        at_least("sample", self, "samples", 1)
        at_least("sample", self, "clips", 0)


# (point,) bool, the sampled points to be touched; or how far hands are to be; or None where nothing was asked.
AskedMap = np.ndarray | AskedDistances | None


@runtime_checkable
class AsksContact(Protocol):
    """A family ready to answer that decides where the object is to be touched, and can say so."""

    def sample_asked(self, requests: Sequence[Request]) -> tuple[Sequence[Clip | LeftOut], Sequence[AskedMap]]:
        """As ``Sampler.sample``, and of each motion the map it was made for, which :data:`AskedMap` describes."""
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

    Requests the family has no answer to stand in ``out/left_out.json``, where there are any. A family that is
    :class:`AsksContact` also gets ``out/asked.npz`` or ``out/asked-distances.npz`` (``hoidata.metrics.asked``).
    annotated_root: clips, annotation, contact and splits of a dataset. checkpoints: folder with one per network.
    params: a :class:`PredictionConfig`; settings: sections of families, by name. The k-th
    motion for a clip is named ``<clip id>~<k>``; lengths and acting hands are the clip's own, of clips longer than a
    model takes the first frames.
    """
    config = build_config(PredictionConfig, params, "params.yaml: sample")
    root, checkpoints = Path(annotated_root), Path(checkpoints)
    reason = _why_not(family, root, checkpoints)
    annotated = None if reason else load_annotated(root, hands)
    test = [] if annotated is None else list(HoiDataset(annotated, "test", crop="start"))
    test = spread(test, config.clips)
    if annotated is None or not test:
        with atomic_folder(out) as partial:
            write_empty(partial, reason or "no test clips")
        return {"clips": 0}
    sources = Sources(annotated, checkpoints, hands, torch.device(device), settings or {})
    with atomic_folder(out) as partial:
        info = annotated.info | {"family": family.name, "sampling_device": sources.device.type}
        left_out, asked = list[LeftOut](), dict[str, np.ndarray | AskedDistances]()
        motions = _made(_motions(family.load(sources), test, config, asked), left_out)
        first = next(motions, None)
        if first is None:
            write_empty(partial, f"no motion of {len(left_out)}: {left_out[0].reason}")
            return {"clips": 0}
        counts = write_store(partial / "clips", chain([first], motions), info)
        _write_asked(partial, asked)
        _write(partial / "diagnostics.json", family.diagnose(sources))
        if left_out:
            _write(partial / LEFT_OUT, [asdict(item) for item in left_out])
    return counts


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """So many of them, evenly spread; all where there are no more, or for 0."""
    count = min(count or len(items), len(items))
    return [items[number * len(items) // count] for number in range(count)]


def requests_for(sample: ClipSample, config: PredictionConfig) -> list[Request]:
    """What is asked of a family in place of a recorded clip: as often as the config says, each with its own seed.

    A motion's seed does not depend on which other clips there are.
    """
    given = Trajectories(sample.hands[..., : GLOBAL_ORIENT_6D.stop], sample.valid, sample.object)
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
            sentence=first_sentence(sample),
            betas=sample.betas,
            template_m=sample.template_m,
            world_from_model=sample.world_from_model,
            gravity_known=sample.gravity_known,
            trajectories=given,
        )
        for number in range(config.samples)
    ]


def first_sentence(sample: ClipSample) -> Sentence:
    """The imperative of a clip, whose features are the first."""
    return Sentence(sample.sentences[0], sample.verb, sample.object_words or None)


def _write_asked(folder: Path, asked: Mapping[str, np.ndarray | AskedDistances]) -> None:
    """The maps motions were made for, each kind in its file; none where there are none."""
    distances = {name: own for name, own in asked.items() if isinstance(own, AskedDistances)}
    if touched := {name: own for name, own in asked.items() if isinstance(own, np.ndarray)}:
        write_asked(folder, touched)
    if distances:
        write_asked_distances(folder, distances)


def _write(path: Path, values: Any) -> None:
    write_whole(path, json.dumps(values, indent=2, sort_keys=True) + "\n")


def _made(answers: Iterator[Clip | LeftOut], left_out: list[LeftOut]) -> Iterator[Clip]:
    """The motions among the answers; the others are added to ``left_out``."""
    for answer in answers:
        if isinstance(answer, LeftOut):
            left_out.append(answer)
        else:
            yield answer


def _motions(
    sampler: Sampler,
    test: Sequence[ClipSample],
    config: PredictionConfig,
    asked: dict[str, np.ndarray | AskedDistances],
) -> Iterator[Clip | LeftOut]:
    """The answers in order; ``asked`` is filled with the contact map of each, where the family has them."""
    starts = range(0, len(test), CLIPS_AT_ONCE)
    for start in track(starts, description="sampling", transient=True):
        chosen = test[start : start + CLIPS_AT_ONCE]
        requests = [request for sample in chosen for request in requests_for(sample, config)]
        if isinstance(sampler, AsksContact):
            answers, maps = sampler.sample_asked(requests)
            asked |= {answer.clip_id: own for answer, own in zip(answers, maps, strict=True) if own is not None}
        else:
            answers = sampler.sample(requests)
        yield from answers


def _why_not(family: Family, root: Path, checkpoints: Path) -> str | None:
    """What is missing: an empty dataset, or a network the family uses."""
    folders = [root / "clips", root / "annotation", root / "contact", *(checkpoints / name for name in family.uses)]
    if reason := next(filter(None, map(empty_reason, folders)), None):
        return reason
    absent = [name for name in family.uses if not (checkpoints / name / FILE_NAME).is_file()]
    return f"not trained: {', '.join(absent)}" if absent else None
