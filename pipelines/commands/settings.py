"""``hoidata settings``: the settings of all data stages, with defaults."""

from pkgutil import resolve_name
from typing import Annotated, Any

import typer
import yaml

from pipelines.commands.project import enter_project

# The dataclass with names, types and defaults of each section.
SECTIONS = {
    "convert": "pipelines.stages.adapters:ConvertSettings",
    "quality": "hoidata.quality.thresholds:Thresholds",
    "contact": "hoidata.contact.settings:ContactSettings",
    "annotate": "hoidata.annotation.settings:AnnotationSettings",
    "evaluator": "models.evaluator.settings:EvaluatorSettings",
    "evaluate": "pipelines.stages.evaluate:EvaluateSettings",
    "controls": "pipelines.stages.controls:ControlSettings",
}


def settings(section: Annotated[str, typer.Argument(help="One section of params.yaml. Default: all.")] = "") -> None:
    """Print the current settings of the data stages, including defaults, in the format of params.yaml."""
    enter_project()
    from hoidata.settings import check_keys, plain_config
    from pipelines.stages.base import load_settings

    check_keys({section: None} if section else {}, list(SECTIONS), "hoidata settings")
    names = [section] if section else list(SECTIONS)
    values = {name: plain_config(load_settings(settings_class(name), name)) for name in names}
    typer.echo(yaml.safe_dump(values, sort_keys=False, width=120), nl=False)


def settings_class(section: str) -> Any:
    """The dataclass of a section."""
    return resolve_name(SECTIONS[section])
