"""The plugin that Prefect loads in a project's folder (entry point group ``prefect.plugins``, see prefect.toml).

Its effects:

- ``prefect deployment run annotate-arctic`` works without the flow's name, although Prefect requires FLOW/DEPLOYMENT.
- Prefect gets the key of this project's server.
- A flow run is killed with the process that serves the flows, since it would obey the next server at the address.
- No process loads results that a server names, because reading them can run code.
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
    """Prefect calls this once on import, and reads its settings again if variables are returned."""
    end_flow_run_with_its_starter()
    refuse_stored_results()
    accept_bare_names(ctx)
    return key_for(ctx.api_url)


def end_flow_run_with_its_starter() -> None:
    """Kill flow runs with the process that serves the flows, which passes its id on in the environment.

    A flow run whose starter has already ended is killed now.
    """
    if "PREFECT__FLOW_RUN_ID" not in os.environ:
        os.environ[SERVING] = str(os.getpid())
        return
    starter = int(os.environ.get(SERVING, os.getppid()))
    end_with_parent(os.getppid())
    if starter not in (process.pid for process in psutil.Process().parents()):
        os.kill(os.getpid(), signal.SIGKILL)


def refuse_stored_results() -> None:
    """Make Prefect refuse stored results: a server could name any file as one, with pickle as its format."""
    from prefect.results import ResultRecord

    def refuse(*_: object, **__: object) -> NoReturn:
        raise BadInput("a state of the Prefect server", "no stored result", "a result to load", "start the run again")

    ResultRecord.deserialize = refuse
    ResultRecord.deserialize_from_result_and_metadata = refuse


def key_for(url: str | None) -> SetupResult | None:
    """The key as Prefect's setting, unless the user set one. A server on another machine never gets it."""
    if "PREFECT_API_AUTH_STRING" in os.environ or not is_loopback(url):
        return None
    key = read_key()
    return SetupResult(env={"PREFECT_API_AUTH_STRING": key}) if key else None


def accept_bare_names(ctx) -> None:
    """Accept deployment names without a flow; only warns if Prefect has moved its client class."""
    try:
        from prefect.client.orchestration._deployments.client import DeploymentAsyncClient
    except ImportError:
        ctx.logger_factory(__name__).warning("this version of Prefect requires deployments as FLOW/DEPLOYMENT")
        return
    wrap_lookup(DeploymentAsyncClient)


def wrap_lookup(client: type) -> None:
    """Make ``client.read_deployment_by_name`` accept a name without a slash if exactly one deployment has it."""
    original = client.read_deployment_by_name

    async def read_deployment_by_name(self, name: str):
        if "/" in name:
            return await original(self, name)
        from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterName

        by_name = DeploymentFilter(name=DeploymentFilterName(any_=[name]))
        matches = await self.read_deployments(deployment_filter=by_name)
        names = [] if matches else [deployment.name for deployment in await self.read_deployments()]
        try:
            return only_one(name, matches, names)
        except ValueError as error:
            if Path(sys.argv[0]).name == "prefect":  # on the command line: a message instead of a traceback
                raise SystemExit(str(error)) from None
            raise

    client.read_deployment_by_name = read_deployment_by_name


def only_one(name: str, matches: list, names: list[str]):
    """The only deployment with that name. Raises ValueError, with similar ``names``, if there are none or several."""
    if len(matches) == 1:
        return matches[0]
    if not matches:
        similar = ", ".join(get_close_matches(name, names, 3, 0.5))
        remedy = f"{f'did you mean {similar}? ' if similar else ''}`prefect deployment ls` lists them"
        raise ValueError(f"no deployment is named {name!r}; {remedy}, `hoidata up` creates them")
    raise ValueError(f"{len(matches)} flows have a deployment named {name!r}; write FLOW/{name}")
