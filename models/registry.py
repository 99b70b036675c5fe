"""Registry of model families and networks. Other packages add families with an entry point:

``[project.entry-points."hoidata.families"]  mine = "my_package.family:MINE"``.
"""

from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from hoidata.errors import BadInput

# Finding the module of a family must not load torch: the stage that digests the code does it on every run.
if TYPE_CHECKING:
    from models.common.family import Family, Network

ENTRY_POINT_GROUP = "hoidata.families"
FAMILIES = {
    "text2hoi": "models.text2hoi.family:TEXT2HOI",
    "text2hoi-coarse": "models.text2hoi.family:COARSE",
    "text2hoi-contact": "models.text2hoi.family:CONTACT_REFINED",
    "text2hoi-estimated": "models.text2hoi.family:ESTIMATED",
    "other-prompt": "models.text2hoi.family:OTHER_PROMPT",
    "nearest-clip": "models.baselines.retrieval:NEAREST_CLIP",
    "mean-motion": "models.baselines.families:MEAN_MOTION",
    "mean-pose": "models.baselines.families:MEAN_POSE",
    "ground-truth": "models.baselines.families:GROUND_TRUTH",
    "manipnet": "models.manipnet.family:FINGERS",
    "bimart": "models.bimart.family:BIMART",
    "bimart-unrefined": "models.bimart.family:UNREFINED",
    "mdm": "models.mdm.family:FAMILY",
    "imos": "models.imos.family:FAMILY",
    "imos-true-start": "models.imos.family:TRUE_START",
    "t2m": "models.t2m.family:FAMILY",
    "t2m-given-length": "models.t2m.family:GIVEN_LENGTH",
    "nearest-window": "models.bimart.retrieval:NEAREST_WINDOW",
    "nearest-window-refined": "models.bimart.retrieval:NEAREST_REFINED",
    "mean-pose-at-object": "models.bimart.retrieval:OBJECT_MEAN_POSE",
    # Negative controls and retrieval baselines: each is expected to be worse in some metric.
    "one-call": "models.text2hoi.controls:ONE_CALL",
    "other-contact": "models.text2hoi.controls:OTHER_CONTACT",
    "other-prompt-own-contact": "models.text2hoi.controls:OTHER_PROMPT_OWN_CONTACT",
    "prompt-retrieval": "models.baselines.retrieval:PROMPT_LOOKUP",
    "prompt-retrieval-refined": "models.baselines.refined_retrieval:PROMPT_RETRIEVAL_REFINED",
    "verb-retrieval": "models.baselines.retrieval:VERB_LOOKUP",
    "verb-retrieval-refined": "models.baselines.refined_retrieval:VERB_RETRIEVAL_REFINED",
    "random-clip": "models.baselines.retrieval:RANDOM_CLIP",
    "other-verb": "models.baselines.retrieval:OTHER_VERB",
    "swapped-hands": "models.baselines.retrieval:SWAPPED_HANDS",
    "static": "models.baselines.controls:STATIC",
    "reversed": "models.baselines.controls:REVERSED",
    "object-moved": "models.baselines.controls:OBJECT_MOVED",
    "other-hands": "models.baselines.controls:OTHER_HANDS",
    "hands-away": "models.baselines.controls:HANDS_AWAY",
    "pressed": "models.baselines.controls:PRESSED",
    "pressed-deep": "models.baselines.controls:PRESSED_DEEP",
    "hands-still": "models.baselines.controls:HANDS_STILL",
    "hands-shifted": "models.baselines.controls:HANDS_SHIFTED",
    "noise": "models.baselines.controls:NOISE",
    "noise-refined": "models.text2hoi.controls:NOISE_REFINED",
    "pressed-refined": "models.text2hoi.controls:PRESSED_REFINED",
    "bimart-other-path": "models.bimart.family:OTHER_PATH",
    "bimart-other-object": "models.bimart.family:OTHER_OBJECT",
    "bimart-zero-map": "models.bimart.family:ZERO_MAP",
}
# One module per network, so that changing one does not train the others again.
NETWORKS = {
    "contact": "models.text2hoi.contact_training:CONTACT",
    "length": "models.text2hoi.length:LENGTH",
    "diffusion": "models.text2hoi.diffusion_training:DIFFUSION",
    "refiner": "models.text2hoi.refiner_training:REFINER",
    "manipnet": "models.manipnet.training:MANIPNET",
    "bimart-contact": "models.bimart.training:CONTACT",
    "bimart-motion": "models.bimart.training:MOTION",
    "mdm": "models.mdm.family:MDM",
    "imos": "models.imos.family:IMOS",
    "t2m-movement": "models.t2m.movement:MOVEMENT",
    "t2m": "models.t2m.generator:GENERATOR",
    "t2m-length": "models.t2m.movement:LENGTH",
}


def family_names() -> list[str]:
    """Names of all families, built-in ones first."""
    return [*FAMILIES, *sorted(point.name for point in _added())]


def family_module(name: str) -> str:
    """The module that defines a family, built in or added by a package."""
    return _address(name).partition(":")[0]


def network_modules(name: str) -> list[str]:
    """The module that defines a built-in network; otherwise the modules of all added families, which may define it."""
    return [address.partition(":")[0] for address in _addresses_of_network(name)]


def load_family(name: str) -> "Family":
    """Load a family by name. Raises BadInput that lists the registered ones."""
    return _load(_address(name))


def load_network(name: str) -> "Network":
    """Load a network by name, of any family. Raises BadInput that lists the registered ones."""
    if name in NETWORKS:
        return _load(NETWORKS[name])
    added = [network for address in _addresses_of_network(name) for network in _load(address).networks]
    by_name = {network.name: network for network in added}
    if name not in by_name:
        names = ", ".join([*NETWORKS, *sorted(by_name)])
        raise BadInput("network", f"one of {names}", name, "correct the name")
    return by_name[name]


def _load(address: str) -> Any:
    module, _, attribute = address.partition(":")
    return getattr(import_module(module), attribute)


def _addresses_of_network(name: str) -> list[str]:
    return [NETWORKS[name]] if name in NETWORKS else sorted(point.value for point in _added())


def _address(name: str) -> str:
    added = {point.name: point.value for point in _added()}
    if name not in FAMILIES | added:
        raise BadInput("family", f"one of {', '.join(family_names())}", name, "correct the name")
    return (added | FAMILIES)[name]


@cache
def _added() -> list[EntryPoint]:
    """Entry points of other packages, read once per process; they cannot replace a built-in name."""
    return [point for point in entry_points(group=ENTRY_POINT_GROUP) if point.name not in FAMILIES]
