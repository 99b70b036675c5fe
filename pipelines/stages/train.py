"""Stage train: train one network on one dataset, and store its provenance in the checkpoint."""

import tempfile
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from hoidata.annotation.encoders import not_clip_note
from hoidata.annotation.settings import AnnotationSettings
from hoidata.errors import BadInput
from hoidata.files import sha256_file
from models.registry import load_network
from pipelines.lineage.graph import look_up, producers, written_graph
from pipelines.lineage.provenance import build_provenance
from pipelines.params import merge_settings, read_file, read_params
from pipelines.stages.base import StagePaths, empty_reason, load_hands, load_settings, write_empty

# Networks that read sentence features.
SENTENCE_READERS = ("contact", "length", "diffusion", "mdm", "imos", "t2m-length")


@dataclass(frozen=True)
class TrainParams:
    """The section ``train`` of params.yaml. The network checks the keys of its preset and size."""

    preset: Literal["paper", "ours"]  # the method
    size: Literal["small", "full"]  # layer sizes and training budgets, merged over the preset
    seed: int
    paper: Mapping[str, Any]
    ours: Mapping[str, Any]
    small: Mapping[str, Any]
    full: Mapping[str, Any]
    processes: int = 1  # that train one network together; ``training.micro_batches`` sets what each step computes

    def of(self, network: str) -> dict[str, Any]:
        """The settings of a network in the chosen preset and size, and the seed; the others keep their defaults."""
        method, size = (getattr(self, name).get(network) or {} for name in (self.preset, self.size))
        return merge_settings(merge_settings(method, size), {"seed": self.seed})


def run(paths: StagePaths) -> None:
    """Train ``paths.model``; a dataset without clips, or without a network that it needs, gives an empty output.

    A killed training resumes: its state and losses are in ``paths.training``.
    """
    needed = [paths.checkpoints / name for name in load_network(paths.model).needs]
    if reason := next(filter(None, map(empty_reason, [paths.clips, *needed])), None):
        write_empty(paths.checkpoint, reason)
        return
    from models.common.team import run_team

    processes = load_settings(TrainParams, "train").processes
    meeting = tempfile.TemporaryDirectory() if processes > 1 else nullcontext("")
    with meeting as folder:
        run_team(train, processes, Path(folder) / "team", paths)


def train(paths: StagePaths) -> None:
    """Run one of the processes that train ``paths.model`` and write its checkpoint."""
    from models.common.repeatable import chosen_device, make_repeatable
    from models.common.team import Team
    from models.common.training import train_network

    settings, params = load_settings(TrainParams, "train"), read_params(Path())
    encoder = (params.get("annotate") or {}).get("encoder", AnnotationSettings.encoder)
    if settings.preset == "paper" and paths.model in SENTENCE_READERS and (note := not_clip_note(encoder)):
        print(f"{paths.model}: {note}")
    network, code = load_network(paths.model), Path("code", "train", f"{paths.model}.json")
    stage = producers(written_graph(Path()))[paths.checkpoint.as_posix()].name
    make_repeatable(threads=1)  # other cores run other stages; ``train.processes`` sets the number for one network
    train_network(
        network,
        paths.data,
        paths.checkpoint,
        settings.of(paths.model),
        load_hands(paths.profile),
        needed={load_network(name): paths.checkpoints / name for name in network.needs},
        provenance=lambda facts: build_provenance(Path(), stage, facts),
        device=Team.joined().device(chosen_device(params.get("device", "auto"))),
        progress=paths.training,
        code=sha256_file(code) if code.is_file() else "",
        full_key=partial(full_key, network.name),
    )


def full_key(network: str, key: str, path: Path = Path("params.yaml")) -> str:
    """The full key in params.yaml that sets a setting of a network, such as ``train.small.length.training.steps``.

    The key of the size if the setting is not in the file, since a size overrides the preset.
    """
    values, chosen = read_file(path), load_settings(TrainParams, "train", path)
    profile = ("profiles", str(values.get("profile")))
    sections = [(*top, "train", name, network) for name in (chosen.size, chosen.preset) for top in (profile, ())]
    keys = [".".join((*section, key)) for section in sections]
    for name in keys:
        with suppress(BadInput):
            look_up(values, name)
            return name
    return keys[1]
