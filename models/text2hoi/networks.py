"""The four networks of Text2HOI in the order they are trained."""

from models.text2hoi.contact_training import CONTACT
from models.text2hoi.diffusion_training import DIFFUSION
from models.text2hoi.length_training import LENGTH
from models.text2hoi.refiner_training import REFINER

NETWORKS = (CONTACT, LENGTH, DIFFUSION, REFINER)
