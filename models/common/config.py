"""Settings of networks and trainings are built as those of the library are."""

from hoidata.settings import build_config, plain_config

__all__ = ["build_config", "plain_config"]
