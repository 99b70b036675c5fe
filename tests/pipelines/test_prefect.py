"""The bare name in ``prefect deployment run annotate-arctic``; test_prefect_security.py types it."""

import asyncio
from types import SimpleNamespace

import pytest

from pipelines.prefect_names import only_one, wrap_lookup


class Client:
    """Stands in for Prefect's client: knows two deployments."""

    async def read_deployment_by_name(self, name: str) -> str:
        return f"original {name}"

    async def read_deployments(self, deployment_filter=None):
        known = ("annotate-arctic", "full-graph")
        wanted = deployment_filter.name.any_ if deployment_filter else known
        return [SimpleNamespace(name=name) for name in known if name in wanted]


def test_a_bare_name_finds_its_deployment_and_the_form_with_a_slash_stays_prefects():
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    assert asyncio.run(Wrapped().read_deployment_by_name("annotate-arctic")).name == "annotate-arctic"
    assert asyncio.run(Wrapped().read_deployment_by_name("a/b")) == "original a/b"
    with pytest.raises(ValueError, match="did you mean annotate-arctic"):
        asyncio.run(Wrapped().read_deployment_by_name("anotate-artic"))


def test_whoever_types_a_wrong_name_gets_an_answer_and_no_traceback(monkeypatch):
    class Wrapped(Client):
        pass

    wrap_lookup(Wrapped)
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/prefect", "deployment", "run", "anotate-artic"])
    with pytest.raises(SystemExit, match="did you mean annotate-arctic"):
        asyncio.run(Wrapped().read_deployment_by_name("anotate-artic"))


@pytest.mark.parametrize(("found", "message"), [([], "no deployment is named"), ([1, 2], "2 flows have")])
def test_a_name_that_none_or_several_have_is_refused(found, message):
    with pytest.raises(ValueError, match=message):
        only_one("annotate-arctic", found, [])
