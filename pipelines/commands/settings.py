"""``hoidata settings``: every setting a stage takes from params.yaml, with what it is set to."""

from importlib import import_module
from typing import Annotated, Any

import typer
import yaml

from pipelines.commands.project import enter_project

# The class that holds names, types and defaults of a section.
SECTIONS = {
    "convert": "pipelines.stages.adapters:ConvertSettings",
    "quality": "hoidata.quality.thresholds:Thresholds",
    "contact": "hoidata.contact.settings:ContactSettings",
    "annotate": "hoidata.annotation.settings:AnnotationSettings",
    "evaluator": "models.evaluator.settings:EvaluatorSettings",
    "evaluate": "pipelines.stages.evaluate:EvaluateSettings",
    "controls": "pipelines.stages.controls:ControlSettings",
}


def settings(section: Annotated[str, typer.Argument(help="One section; all when left out.")] = "") -> None:
    """Print all settings of the data stages as they are now, defaults included, in the form of params.yaml."""
    enter_project()
    from hoidata.settings import plain_config, refuse_unknown
    from pipelines.stages.base import load_settings

    refuse_unknown({section: None} if section else {}, list(SECTIONS), "hoidata settings")
    names = [section] if section else list(SECTIONS)
    found = {name: plain_config(load_settings(settings_class(name), name)) for name in names}
    typer.echo(yaml.safe_dump(found, sort_keys=False, width=120), nl=False)


def settings_class(section: str) -> Any:
    """The dataclass of a section."""
    module, name = SECTIONS[section].split(":")
    return getattr(import_module(module), name)
