"""Stage evaluator: action classifiers for the metrics, trained on the recorded clips of one dataset."""

from dataclasses import replace
from pathlib import Path

from hoidata.files import sha256_file
from models.evaluator.settings import EvaluatorSettings
from pipelines.lineage.graph import producers, written_graph
from pipelines.stages.base import StagePaths, empty_reason, jobs, load_hands, load_settings, write_empty

CODE = Path("code/evaluator.json")
OFF = "off: params.yaml names no networks under evaluator"


def run(paths: StagePaths) -> None:
    """Train the networks; a dataset without clips or labels, or settings without networks, give an empty output."""
    settings = load_settings(EvaluatorSettings, "evaluator")
    folders = (paths.clips, paths.annotation, paths.contact, paths.splits)
    reason = next(filter(None, map(empty_reason, folders)), None) if settings.networks else OFF
    if reason:
        write_empty(paths.evaluators, reason)
        return
    from models.common.repeatable import make_repeatable
    from models.evaluator.stage import train_evaluators
    from pipelines.lineage.provenance import build_provenance

    make_repeatable(threads=1)
    stage = producers(written_graph(Path()))[paths.evaluators.as_posix()].name
    result = train_evaluators(
        paths.data,
        paths.evaluators,
        settings,
        load_hands(paths.profile),
        jobs=jobs(),
        provenance=lambda facts: build_provenance(Path(), stage, facts),
        progress=replace(paths, model="evaluator").training,
        code=sha256_file(CODE) if CODE.is_file() else "",
    )
    if isinstance(result, str):
        write_empty(paths.evaluators, result)
        return
    for name, facts in result["evaluators"].items():
        print(f"{paths}: {name}: {facts.get('accuracy') or facts['loss']}")
