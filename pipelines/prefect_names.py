"""Lets Prefect find a deployment by its own name: ``prefect deployment run annotate-arctic``.

Prefect wants FLOW/DEPLOYMENT and has no setting for less, so this start-up hook (entry point group
``prefect.plugins``, switched on in prefect.toml) wraps its look-up by name. The form with a slash always works.
"""

from prefect.plugins import register_hook


@register_hook
def setup_environment(*, ctx) -> None:
    """Called once when Prefect is imported. Leaves Prefect as it is when its client is not where it used to be."""
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
        return only_one(name, await _deployments_named(self, name))

    client.read_deployment_by_name = read_deployment_by_name


async def _deployments_named(client, name: str) -> list:
    from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterName

    return await client.read_deployments(deployment_filter=DeploymentFilter(name=DeploymentFilterName(any_=[name])))


def only_one(name: str, found: list):
    """The one deployment of that name. Raises ValueError when there is none, or more than one flow has one."""
    if len(found) == 1:
        return found[0]
    if not found:
        raise ValueError(
            f"no deployment is named {name!r}; `prefect deployment ls` lists them, `hoidata up` makes them"
        )
    raise ValueError(f"{len(found)} flows have a deployment named {name!r}; write FLOW/{name}")
