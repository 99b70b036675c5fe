"""What Prefect loads at its start in a project's folder (entry point group ``prefect.plugins``, see prefect.toml).

The hook does four things:

- ``prefect deployment run annotate-arctic`` works as typed. Prefect wants FLOW/DEPLOYMENT and has no setting for less,
  so its look-up by name is wrapped; the form with a slash always works.
- It hands over the key to this project's server.
- A flow run ends with the process that serves the flows, because it would obey whoever listens at the address next.
- No process loads results that a server points to, because reading them can run code.
"""

import os
import signal
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn

import psutil
from prefect.plugins import SetupResult, register_hook

from hoidata.errors import BadInput
from hoidata.lifetime import end_with_parent
from pipelines.prefect_server import is_loopback, read_key

SERVING = "HOIDATA_PREFECT_SERVING"


@register_hook
def setup_environment(*, ctx) -> SetupResult | None:
    """Called once when Prefect is imported; Prefect reads its settings again when variables are returned."""
    end_flow_run_with_its_starter()
    refuse_stored_results()
    accept_bare_names(ctx)
    return key_for(ctx.api_url)


def end_flow_run_with_its_starter() -> None:
    """The process that serves the flows leaves its id to those of its flow runs, which the kernel then ends with it.

    A flow run whose starter ended while Prefect was imported ends now.
    """
    if "PREFECT__FLOW_RUN_ID" not in os.environ:
        os.environ[SERVING] = str(os.getpid())
        return
    starter = int(os.environ.get(SERVING, os.getppid()))
    end_with_parent(os.getppid())
    if starter not in (process.pid for process in psutil.Process().parents()):
        os.kill(os.getpid(), signal.SIGKILL)


def refuse_stored_results() -> None:
    """Our flows store no results. A state of the server may name any file as one, and pickle as its format."""
    from prefect.results import ResultRecord

    def refuse(*_: object, **__: object) -> NoReturn:
        raise BadInput("a state of the Prefect server", "no stored result", "one to be loaded", "start the run again")

    ResultRecord.deserialize = refuse
    ResultRecord.deserialize_from_result_and_metadata = refuse


def key_for(url: str | None) -> SetupResult | None:
    """The key as Prefect's setting, unless the user set one; a server that is not on this machine never gets it."""
    if "PREFECT_API_AUTH_STRING" in os.environ or not is_loopback(url):
        return None
    key = read_key()
    return SetupResult(env={"PREFECT_API_AUTH_STRING": key}) if key else None


def accept_bare_names(ctx) -> None:
    """Leaves Prefect as it is when its client is not where it used to be."""
    try:
        from prefect.client.orchestration._deployments.client import DeploymentAsyncClient
    except ImportError:
        ctx.logger_factory(__name__).warning("this Prefect wants deployments as FLOW/DEPLOYMENT")
        return
    wrap_lookup(DeploymentAsyncClient)


def wrap_lookup(client: type) -> None:
    """Make ``client.read_deployment_by_name`` accept a name without a slash, where exactly one deployment has it."""
    original = client.read_deployment_by_name

    async def read_deployment_by_name(self, name: str):
        if "/" in name:
            return await original(self, name)
        found = await _deployments_named(self, name)
        names = [] if found else await _all_names(self)
        try:
            return only_one(name, found, names)
        except ValueError as error:
            if Path(sys.argv[0]).name == "prefect":  # whoever types a name wants an answer, not a traceback
                raise SystemExit(str(error)) from None
            raise

    client.read_deployment_by_name = read_deployment_by_name


async def _deployments_named(client, name: str) -> list:
    from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterName

    return await client.read_deployments(deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[name])))


async def _all_names(client) -> list[str]:
    return [deployment.name for deployment in await client.read_deployments()]


def only_one(name: str, found: list, names: list[str]):
    """The one deployment of that name. Raises ValueError, with the nearest of ``names``, when there is not just one."""
    if len(found) == 1:
        return found[0]
    if not found:
        near = ", ".join(get_close_matches(name, names, 3, 0.5))
        meant = f"did you mean {near}? " if near else ""
        raise ValueError(
            f"no deployment is named {name!r}; {meant}`prefect deployment ls` lists them, `hoidata up` makes them"
        )
    raise ValueError(f"{len(found)} flows have a deployment named {name!r}; write FLOW/{name}")
