"""The four networks of Text2HOI, each with its config, its objective and what must be trained before it."""

from dataclasses import replace

from torch import nn

from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus
from models.common.family import Network, Objective, Setup
from models.common.features import Normaliser
from models.text2hoi.contact import ContactConfig, ContactLossConfig, ContactModel
from models.text2hoi.diffusion import DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.length import LengthConfig, LengthModel
from models.text2hoi.objectives import ContactObjective, DiffusionLossConfig, DiffusionObjective, LengthObjective
from models.text2hoi.refiner import RefinerConfig, RefinerModel
from models.text2hoi.refiner_objective import RefinerLossConfig, RefinerObjective
from models.text2hoi.surface import Surface
from models.text2hoi.thresholds import choose_contact_threshold


def contact_threshold(checkpoint: Checkpoint) -> float:
    """The probability from which a point counts as touched, chosen on validation clips with the contact network."""
    return float(checkpoint.info["results"]["contact_threshold"])


def motion_generator(checkpoint: Checkpoint) -> MotionGenerator:
    """The motion generator of a diffusion checkpoint."""
    assert isinstance(checkpoint.network, DiffusionModel)
    assert checkpoint.normaliser is not None
    return MotionGenerator(checkpoint.network, checkpoint.normaliser)


def _contact_objective(setup: Setup) -> tuple[Objective, None]:
    return ContactObjective(ContactModel(setup.network).to(setup.device), setup.loss, setup.corpus, setup.device), None


def _contact_results(network: nn.Module, corpus: Corpus) -> dict[str, float]:
    assert isinstance(network, ContactModel)
    return {"contact_threshold": choose_contact_threshold(network, corpus.held_out)}


def _length_objective(setup: Setup) -> tuple[Objective, None]:
    return LengthObjective(LengthModel(setup.network).to(setup.device), setup.corpus, setup.device), None


def _diffusion_objective(setup: Setup) -> tuple[Objective, Normaliser]:
    contact = setup.trained["contact"].network
    assert isinstance(contact, ContactModel)
    network = DiffusionModel(replace(setup.network, point_net=contact.config.point_net)).to(setup.device)
    network.object_net.load_state_dict(contact.object_net.state_dict())
    normaliser = Normaliser.of(list(setup.corpus.train)).to(setup.device)
    return DiffusionObjective(network, setup.loss, setup.corpus, setup.hands, normaliser, setup.device), normaliser


def _refiner_objective(setup: Setup) -> tuple[Objective, None]:
    generator = motion_generator(setup.trained["diffusion"])
    network = RefinerModel(setup.network).to(setup.device)
    models = [sample.object_model for sample in (*setup.corpus.train, *setup.corpus.held_out)]
    surface = Surface.of(setup.hands, models, setup.loss.field_resolution, setup.device)
    return RefinerObjective(network, setup.loss, setup.corpus, generator, surface, setup.device, setup.seed), None


CONTACT = Network(
    "contact", ContactConfig, ContactModel, _contact_objective, ContactLossConfig, results=_contact_results
)
LENGTH = Network("length", LengthConfig, LengthModel, _length_objective)
DIFFUSION = Network(
    "diffusion", DiffusionConfig, DiffusionModel, _diffusion_objective, DiffusionLossConfig, needs=("contact",)
)
REFINER = Network(
    "refiner", RefinerConfig, RefinerModel, _refiner_objective, RefinerLossConfig, needs=("diffusion",), crop="start"
)
NETWORKS = (CONTACT, LENGTH, DIFFUSION, REFINER)
