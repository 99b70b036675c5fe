"""Plugin that Prefect loads when it starts in a project folder: the hook of ``pipelines.prefect_hook``."""

from importlib import import_module

from hoidata.package_paths import add_to_path

add_to_path()
setup_environment = import_module("pipelines.prefect_hook").setup_environment
