"""Fixtures shared by all tests, whose builders are in tests/builders; and the order in which modules begin."""

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

from hoidata.clips import Clip
from tests.builders.clips import build_clip


def pytest_configure(config: pytest.Config) -> None:
    """xdist would begin with the modules of many tests, and end with the few that take minutes."""
    config.option.loadscopereorder = False
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # In the background of a script; processes that tests start and interrupt would ignore it by inheritance.
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("first") is None)


@pytest.fixture(autouse=True)
def _usual_process() -> Iterator[None]:
    """Commands set threads, precision and algorithms of the process, and what files are checked against; no test, and
    no fixture that tests share, is to notice which ran before it."""
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
    """Call it with a name and a function that fills a folder: filled once for all workers. Tests change only copies."""
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
    """Call it with a dataset's name: its small embedded corpus (raw), converted (clips), and what it was made from."""
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
