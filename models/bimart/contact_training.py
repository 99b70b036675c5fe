"""The contact diffusion model as a network of the registry."""

from models.bimart.learning import LossConfig, Objective
from models.bimart.network import ContactModel, DenoiserConfig
from models.common.family import Network

CONTACT = Network(
    "bimart-contact",
    DenoiserConfig,
    ContactModel,
    lambda setup: (Objective(setup, ContactModel(setup.network)), None),
    LossConfig,
)
