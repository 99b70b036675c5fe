"""Facts of each run of a stage (time, duration, machine) in ``.hoidata/runs``, outside of the stage's outputs.

They differ from run to run, so DVC must not track them. No stage reads them, and they may be deleted.
"""

import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

RUNS = Path(".hoidata/runs")
SCHEMA = "hoidata.run/1"


@contextmanager
def noted_run(name: str) -> Iterator[None]:
    """Record the facts of the block as a run of the stage of DVC_STAGE, else ``name``, also if it fails."""
    stage, began, start = os.environ.get("DVC_STAGE", name), datetime.now(UTC), time.monotonic()
    ended = "failed"
    try:
        yield
        ended = "complete"
    finally:
        facts = {
            "schema": SCHEMA,
            "stage": stage,
            "ended": ended,
            "began_at": began.isoformat(),
            "seconds": round(time.monotonic() - start, 3),
            **_cost(),
            **_machine(),
        }
        with suppress(OSError):  # the stage itself reports a full disk
            path = RUNS / f"{stage.replace('/', '-').replace(':', '-')}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(facts, indent=1) + "\n")


def _cost() -> dict[str, float]:
    """Processor time and peak memory of this process and its children."""
    self_usage, child_usage = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    seconds = self_usage.ru_utime + self_usage.ru_stime + child_usage.ru_utime + child_usage.ru_stime
    peak_mib = max(self_usage.ru_maxrss, child_usage.ru_maxrss) // 1024
    return {"processor_seconds": round(seconds, 2), "peak_mib": peak_mib}


def _machine() -> dict[str, Any]:
    from hoidata.processor import processor_name

    torch = sys.modules.get("torch")  # not imported here
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    git = subprocess.run(["git", "rev-parse", "--verify", "--quiet", "HEAD"], capture_output=True, text=True)
    return {
        "host": platform.node(),
        "processor": processor_name(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(memory / 2**30, 1),
        "device": torch.cuda.get_device_name() if torch and torch.cuda.is_initialized() else "cpu",
        "python": platform.python_version(),
        "system": platform.platform(),
        "commit": git.stdout.strip(),
    }
