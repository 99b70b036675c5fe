"""What Prefect loads at its start in a project's folder: the hook of ``pipelines.prefect_hook``."""

from importlib import import_module

from hoidata.beside import add_to_path

add_to_path()
setup_environment = import_module("pipelines.prefect_hook").setup_environment
