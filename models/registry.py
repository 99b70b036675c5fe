"""All model families: the one table that names them, and where they are. Other packages add theirs by an entry point.

``[project.entry-points."hoidata.families"]  mine = "my_package.family:MINE"``.
"""

from importlib import import_module
from importlib.metadata import EntryPoint, entry_points

from hoidata.errors import BadInput
from models.common.family import Family, Network

ENTRY_POINT_GROUP = "hoidata.families"
FAMILIES = {
    "text2hoi": "models.text2hoi.family:TEXT2HOI",
    "text2hoi-coarse": "models.text2hoi.family:COARSE",
    "other-prompt": "models.text2hoi.family:OTHER_PROMPT",
    "nearest-clip": "models.baselines.families:NEAREST_CLIP",
    "mean-motion": "models.baselines.families:MEAN_MOTION",
    "mean-pose": "models.baselines.families:MEAN_POSE",
    "ground-truth": "models.baselines.families:GROUND_TRUTH",
}


def family_names() -> list[str]:
    """Names of all known families, built-in ones first."""
    return [*FAMILIES, *sorted(point.name for point in _added())]


def family_module(name: str) -> str:
    """The module that defines a family, for a built-in one or another package's."""
    return _address(name).partition(":")[0]


def load_family(name: str) -> Family:
    """A family by name. Raises BadInput that lists the known ones."""
    module, _, attribute = _address(name).partition(":")
    return getattr(import_module(module), attribute)


def load_network(name: str) -> Network:
    """A network by its name, of whatever family. Raises BadInput that lists the known ones."""
    networks = {network.name: network for family in family_names() for network in load_family(family).networks}
    if name not in networks:
        raise BadInput("network", f"one of {', '.join(sorted(networks))}", name, "correct the name")
    return networks[name]


def _address(name: str) -> str:
    added = {point.name: point.value for point in _added()}
    if name not in FAMILIES | added:
        raise BadInput("family", f"one of {', '.join(family_names())}", name, "correct the name")
    return (added | FAMILIES)[name]


def _added() -> list[EntryPoint]:
    """Entry points of other packages; a built-in name cannot be taken over."""
    return [point for point in entry_points(group=ENTRY_POINT_GROUP) if point.name not in FAMILIES]
