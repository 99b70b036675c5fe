"""Stage table_networks: one network of a variant and seed of BimArt's tables; ``paths.family`` is, say, ``part-0``."""

from pathlib import Path

from models.bimart_tables.variants import VARIANTS, variant_of
from pipelines.params import laid_over
from pipelines.stages.base import StagePaths, empty_reason, load_settings, write_empty
from pipelines.stages.train import TrainParams, train_into

CODE = Path("code/table_networks")


def run(paths: StagePaths) -> None:
    """Train ``paths.model`` as the variant changes it; an empty output where the variant has no such network."""
    name, seed = variant_of(paths.family)
    networks = VARIANTS[name]
    none = "" if paths.model in networks else f"{paths.family} has no network {paths.model}"
    if reason := none or empty_reason(paths.clips):
        write_empty(paths.table_network, reason)
        return
    params = laid_over(load_settings(TrainParams, "train").of(paths.model), networks[paths.model])
    code = CODE / f"{paths.model}.json"
    train_into(paths.table_network, paths, {**params, "seed": seed}, paths.table_training, code)
