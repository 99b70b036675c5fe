"""The adapter of a dataset with the settings of params.yaml: what scanning, checking and converting share."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hoidata.datasets.base import Adapter
from hoidata.datasets.registry import get_adapter
from hoidata.errors import BadInput
from pipelines.stages.base import load_settings


@dataclass(frozen=True)
class ConvertSettings:
    """margin_frames: kept before and after each interaction at 30 fps, None: as each adapter does by itself.

    adapters: by dataset, the fields of its adapter's class that are to differ.
    """

    margin_frames: int | None = None
    adapters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.margin_frames is not None and self.margin_frames < 0:
            raise BadInput("convert.margin_frames", "0 or more frames", f"{self.margin_frames}", "correct it")

    def adapter(self, name: str) -> Adapter:
        """The adapter of that dataset with its settings; its own ``margin_frames`` wins over the common one."""
        # Without a margin nothing is said of it, so that an adapter without that setting works too.
        common = {"margin_frames": self.margin_frames} if self.margin_frames else {}
        return get_adapter(name, **{**common, **(self.adapters.get(name) or {})})


def configured_adapter(name: str) -> Adapter:
    """The adapter with the settings of params.yaml. Raises MissingResource for an unknown name, BadInput else."""
    return load_settings(ConvertSettings, "convert").adapter(name)
