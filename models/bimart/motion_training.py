"""The motion diffusion model as a network of the registry; it learns from recorded contact maps."""

from models.bimart.learning import LossConfig, Objective
from models.bimart.network import DenoiserConfig, MotionModel
from models.common.family import Network

MOTION = Network(
    "bimart-motion",
    DenoiserConfig,
    MotionModel,
    lambda setup: (Objective(setup, MotionModel(setup.network)), None),
    LossConfig,
)
