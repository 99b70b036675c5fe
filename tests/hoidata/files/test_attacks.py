"""Files made to exhaust a machine are refused in seconds and within some hundred megabytes."""

import json
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hoidata.errors import BadInput
from tests.hoidata.files.attacks import ATTACKS, MB

MOST_SECONDS, MOST_MEGABYTES = 4, 500


def high_water_kb() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def in_a_process_of_its_own(read: Callable[[Path], Any], path: Path) -> dict:
    """What reading came to, its processor time and the memory it took; it is ended at twice what is allowed."""
    receiving, sending = os.pipe()
    child = os.fork()
    if not child:
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (2 * MOST_SECONDS + int(time.process_time()),) * 2)
            mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (mapped + 4 * MOST_MEGABYTES * MB,) * 2)
            Path("/proc/self/clear_refs").write_text("5")
            before, start = high_water_kb(), time.process_time()
            try:
                end = f"read: {type(read(path))}"
            except BaseException as error:
                end = f"{type(error).__name__}: {error}"
            took = {"end": end[:500], "seconds": time.process_time() - start}
            os.write(sending, json.dumps({**took, "megabytes": (high_water_kb() - before) / 1024}).encode())
        finally:
            os._exit(0)
    os.close(sending)
    with os.fdopen(receiving, "rb") as stream:
        report = stream.read()
    os.waitpid(child, 0)
    return json.loads(report or b'{"end": "was ended", "seconds": 99, "megabytes": 9999}')


@pytest.mark.slow
@pytest.mark.parametrize(("name", "make", "read"), ATTACKS, ids=[name for name, *_ in ATTACKS])
def test_a_small_file_that_expands_without_bound_is_bad_input_immediately(tmp_path, name, make, read):
    path = tmp_path / name
    path.write_bytes(make())
    outcome = in_a_process_of_its_own(read, path)
    assert outcome["end"].startswith(BadInput.__name__), outcome
    assert outcome["seconds"] < MOST_SECONDS, outcome
    assert outcome["megabytes"] < MOST_MEGABYTES, outcome
