"""Stage train_listed: a network of a family that is trained only where params.yaml lists the family."""

from pipelines.stages import train
from pipelines.stages.base import StagePaths, write_empty
from pipelines.stages.listed import off_reason


def run(paths: StagePaths) -> None:
    """As the stage ``train``; an empty output with the reason where ``paths.family`` is not listed."""
    if reason := off_reason(paths.family):
        write_empty(paths.checkpoint, reason)
        return
    train.run(paths)
