"""Work on a Dask cluster gives the bytes of one local process, also when workers die."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

import pytest

from hoidata import workers
from hoidata.contact.stage import contact_store
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import BadInput
from hoidata.files.atomic import sha256_file
from hoidata.hands import load_embedded_hands
from hoidata.workers import in_order, map_in_workers
from tests.hoidata.conversion.killable import write_grab

distributed = pytest.importorskip("distributed")
only_in_chaos = pytest.mark.skipif("HOIDATA_CHAOS" not in os.environ, reason="`make chaos` runs it")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # of Dask's threads when they end
DIES = "s1/mug_lift_002"


@dataclass(frozen=True)
class DyingOnce(GrabAdapter):
    """Kills its worker at the first load of one sequence, and then creates the file ``note``."""

    note: str = ""

    def load(self, raw, key, hands):
        if key.name == DIES and not os.path.exists(self.note):
            Path(self.note).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().load(raw, key, hands)


@dataclass(frozen=True)
class DyingAlways(GrabAdapter):
    def load(self, raw, key, hands):
        if key.name == DIES:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().load(raw, key, hands)


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    """Raw files, and the store and contact that one local process makes from them."""
    folder, hands = tmp_path_factory.mktemp("corpus"), load_embedded_hands()
    write_grab(folder / "raw", hands, 9)
    convert_dataset(GrabAdapter(), folder / "raw", hands, folder / "clips", progress=False)
    contact_store(folder / "clips", folder / "contact")
    return folder


@pytest.fixture(scope="module")
def scheduler():
    """The address of a running cluster with two worker processes."""
    import dask

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as started,
    ):
        yield started.scheduler_address


@pytest.fixture
def on_cluster(scheduler):
    workers.choose_workers(scheduler)
    yield
    workers.choose_workers("local")


def digests(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256_file(path) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long
def test_a_cluster_makes_the_store_and_contact_of_one_local_process(corpus, hands, on_cluster, tmp_path, monkeypatch):
    monkeypatch.chdir(corpus)  # relative paths are relative to the client's folder
    convert_dataset(GrabAdapter(), "raw", hands, tmp_path / "clips", progress=False)
    assert digests(tmp_path / "clips") == digests(corpus / "clips")
    contact_store("clips", tmp_path / "contact")
    assert digests(tmp_path / "contact") == digests(corpus / "contact")


def test_a_killed_cluster_worker_changes_no_byte(corpus, hands, on_cluster, tmp_path):
    adapter = DyingOnce(note=str(tmp_path / "died"))
    convert_dataset(adapter, corpus / "raw", hands, tmp_path / "clips", progress=False)
    assert (tmp_path / "died").exists()
    assert digests(tmp_path / "clips") == digests(corpus / "clips")


@only_in_chaos
def test_a_sequence_that_ends_each_worker_is_quarantined_and_the_others_are_not(corpus, hands, on_cluster, tmp_path):
    summary = convert_dataset(DyingAlways(), corpus / "raw", hands, tmp_path / "clips", progress=False)
    assert summary.clips == 8
    (quarantined,) = summary.quarantined
    assert quarantined.source_key == f"grab/{DIES}"
    assert "several workers" in quarantined.got


@pytest.mark.long
def test_other_users_of_the_machine_cannot_connect_to_a_local_cluster():
    workers.choose_workers("dask")
    try:
        with workers._client(1) as client:
            address = client.scheduler.address
            assert client.submit(doubled, 2).result() == 4
            for theirs, at in ((None, address.replace("tls:", "tcp:")), (distributed.Security.temporary(), address)):
                with pytest.raises(OSError):  # noqa: PT011 - the message of the handshake depends on the system
                    distributed.Client(at, security=theirs, timeout=2, set_as_default=False)
    finally:
        workers.choose_workers("local")


def doubled(number: int) -> int:
    if number < 0:
        raise BadInput("number", "0 or more", str(number), "correct it")
    return 2 * number


def test_an_exception_of_the_function_is_raised_and_in_order_sorts_results(on_cluster):
    numbers = list(range(40))
    assert list(in_order(map_in_workers(doubled, numbers, 1), numbers)) == [(number, 2 * number) for number in numbers]
    with pytest.raises(BadInput, match="0 or more"):
        list(map_in_workers(doubled, [1, -1, 2], 1))


def test_a_cluster_without_a_worker_is_refused(monkeypatch):
    monkeypatch.setattr(workers, "PATIENCE_S", 1)
    with distributed.LocalCluster(n_workers=0, dashboard_address=None) as empty:
        workers.choose_workers(empty.scheduler_address)
        try:
            with pytest.raises(BadInput, match="none for 1 s"):
                list(map_in_workers(doubled, [1, 2], 1))
        finally:
            workers.choose_workers("local")


@only_in_chaos
def test_a_cluster_started_for_a_call_ends_with_it(monkeypatch):
    workers.choose_workers("dask")
    try:
        assert not workers.uses_cluster(1)
        assert sorted(map_in_workers(doubled, [1, 2, 3], 2)) == [(1, 2), (2, 4), (3, 6)]
    finally:
        workers.choose_workers("local")


def test_an_unreachable_or_invalid_address_is_refused(monkeypatch):
    monkeypatch.setattr(workers, "PATIENCE_S", 1)
    with pytest.raises(BadInput, match="local, dask or"):
        workers.choose_workers("ray")
    workers.choose_workers("tcp://127.0.0.1:9")
    try:
        with pytest.raises(BadInput, match="a Dask scheduler at"):
            list(map_in_workers(doubled, [1, 2], 1))
    finally:
        workers.choose_workers("local")
