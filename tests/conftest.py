"""Fixtures for all tests, and the order of the test modules. Builders of data are in tests/builders."""

import os
import pickle
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock

from hoidata.processor import portable_kernels

# Before numpy is loaded: the kernels of the commands, so that fixtures have the bytes of the stages.
os.environ.update(portable_kernels())

from hoidata.clips import Clip
from tests.builders.clips import build_clip


def pytest_configure(config: pytest.Config) -> None:
    """Start slow modules first; xdist would start with the modules of many tests, and end with slow ones."""
    config.option.loadscopereorder = False
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # Tests in the background of a script inherit an ignored SIGINT, and so would the processes that they interrupt.
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("first") is None)


@pytest.fixture(autouse=True)
def _usual_process() -> Iterator[None]:
    """Reset process settings that commands change: threads, precision, algorithms and digest checks."""
    yield
    if written := sys.modules.get("hoidata.files.written"):
        written._digest_sources.clear()
    if torch := sys.modules.get("torch"):
        torch.set_num_threads(1)
        torch.set_deterministic_debug_mode("default")
        torch.set_float32_matmul_precision("highest")


@pytest.fixture
def make_clip() -> Callable[..., Clip]:
    """See ``build_clip``."""
    return build_clip


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """A function (name, fill) that returns a folder, filled once for all workers; tests change only copies."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def make(name: str, fill: Callable[[Path], object]) -> Path:
        folder, partial = shared / name, shared / f"{name}.part"
        with FileLock(f"{folder}.lock"):
            if not folder.exists():
                shutil.rmtree(partial, ignore_errors=True)
                partial.mkdir()
                fill(partial)
                partial.rename(folder)
        return folder

    return make


@pytest.fixture(scope="session")
def small_corpus(made_once) -> Callable[[str], SimpleNamespace]:
    """A function that returns the small embedded corpus of a dataset: raw files, clips and their sources."""
    from hoidata.conversion.convert import convert_dataset
    from hoidata.datasets import get_adapter
    from hoidata.hands import load_embedded_hands
    from hoidata.synthetic.corpus import write_corpus

    def of(name: str) -> SimpleNamespace:
        def fill(folder: Path) -> None:
            truths = write_corpus(name, folder / "raw", seed=0, size="small", jobs=1)
            (folder / "truths.pkl").write_bytes(pickle.dumps(truths))
            adapter, hands = get_adapter(name), load_embedded_hands()
            summary = convert_dataset(adapter, folder / "raw", hands, folder / "clips", progress=False, synthetic=True)
            assert summary.quarantined == ()

        folder = made_once(f"small-{name}", fill)
        truths = pickle.loads((folder / "truths.pkl").read_bytes())
        return SimpleNamespace(raw=folder / "raw", clips=folder / "clips", truths=truths)

    return of
