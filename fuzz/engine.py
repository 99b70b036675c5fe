"""Fuzzing of one parser by atheris (libFuzzer), in a process of its own.

A fault is any exception but BadInput and MissingResource, any warning, a call over one second of processor time, no end
within 30 s, or memory refused by the limit of 1 GiB above what the process had at its start. The first fault ends the
parser's run, and its input is saved.
"""

import contextlib
import faulthandler
import multiprocessing
import os
import random
import re
import resource
import shutil
import time
import types
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import atheris

from fuzz.coverage import code_objects, lines_of, lines_reached
from fuzz.structure import LONGEST, NUMBERS, Bytes
from hoidata.errors import BadInput, MissingResource
from hoidata.files import sha256_bytes
from hoidata.lifetime import end_with_parent

SLOWEST_S = 1.0
HANG_S = 30
MEMORY_BYTES = 1 << 30
_STRUCTURED = 0.6
_LONGEST_WORD = 64  # libFuzzer takes no longer ones


@dataclass(frozen=True)
class Target:
    """One parser. seeds: small valid files; run: parses bytes; code: functions that guide, and whose lines count.

    structure: mutation that knows the format; longest: inputs are not made larger than this.
    """

    name: str
    seeds: Callable[[], Sequence[bytes]]
    run: Callable[[bytes], Any]
    code: Sequence[Any]
    tokens: Sequence[bytes] = ()
    structure: Bytes | None = None
    longest: int = LONGEST
    structured_only: bool = False


@dataclass
class Outcome:
    """What happened to one target. fault: what it was, or empty; input_path: the input that did it."""

    name: str
    executions: int = 0
    seconds: float = 0.0
    peak_mib: int = 0  # above what the process held before
    lines: int = 0
    missing: list[str] = field(default_factory=list)
    fault: str = ""
    input_path: str = ""


def fuzz(target: Target, seed: int, executions: int, seconds: float, folder: Path) -> Outcome:
    """Run one target until either limit. folder: gets the corpus, libFuzzer's log and an input that failed."""
    own = folder.resolve() / target.name
    shutil.rmtree(own, ignore_errors=True)
    (own / "corpus").mkdir(parents=True)
    for number, data in enumerate(target.seeds()):
        (own / "corpus" / f"seed-{number:03d}").write_bytes(data)
    words = {word for word in (*target.tokens, *NUMBERS) if 0 < len(word) <= _LONGEST_WORD}
    escaped = ("".join(f"\\x{byte:02x}" for byte in word) for word in sorted(words))
    (own / "words").write_text("".join(f'"{word}"\n' for word in escaped))
    begin, held_mib = time.perf_counter(), _pages_held(1) * resource.getpagesize() >> 20
    # Forked: what all parsers import is imported once. What this process holds already is not the parser's.
    process = multiprocessing.get_context("fork").Process(target=_run, args=(target, seed, executions, seconds, own))
    process.start()
    process.join(seconds + 4 * HANG_S)
    process.kill()
    process.join()
    outcome = _outcome(target, own, process.exitcode)
    outcome.seconds = time.perf_counter() - begin
    outcome.peak_mib = max(0, outcome.peak_mib - held_mib)
    return outcome


def _run(target: Target, seed: int, executions: int, seconds: float, own: Path) -> None:
    """In the child: hands the process to libFuzzer, which ends it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    end_with_parent(int(parent.pid or 0))
    log = os.open(own / "log", os.O_CREAT | os.O_WRONLY)
    os.dup2(log, 1)
    os.dup2(log, 2)
    faulthandler.disable()  # pytest's: libFuzzer sets no handler of its own where there is one
    _guide_by(target.code)
    mutator = {"custom_mutator": lambda *given: _mutated(target, *given)} if target.structure else {}
    longest = max(target.longest, *(path.stat().st_size for path in (own / "corpus").iterdir()))
    whole_seconds = max(1, round(seconds))  # 0 would mean no limit at all
    options = {
        "runs": executions, "max_total_time": whole_seconds, "seed": seed + 1, "max_len": longest, "timeout": HANG_S,
        "rss_limit_mb": 0, "print_final_stats": 1, "artifact_prefix": f"{own}/", "dict": own / "words",
    }  # fmt: skip
    flags = [f"-{name}={value}" for name, value in options.items()]
    atheris.Setup(
        [target.name, *flags, str(own / "corpus")], lambda data: _check_and_save(target, data, own), **mutator
    )
    _limit_memory()
    warnings.simplefilter("error")  # a file must not make a conversion print warnings either
    atheris.Fuzz()


def check_call(target: Target, data: bytes) -> None:
    """Run the parser; what is raised here is a fault."""
    begin = time.process_time()
    try:
        target.run(data)
    except (BadInput, MissingResource) as error:
        if "MemoryError" in str(error):
            raise
    if time.process_time() - begin > SLOWEST_S:
        raise TimeoutError(f"{time.process_time() - begin:.2f} s")


def _check_and_save(target: Target, data: bytes, own: Path) -> None:
    """libFuzzer itself saves the inputs of hangs and crashes of compiled code only."""
    try:
        check_call(target, data)
    except BaseException:
        (own / f"crash-{sha256_bytes(data)[:16]}").write_bytes(data)
        raise


def _mutated(target: Target, data: bytes, longest: int, seed: int) -> bytes:
    rng = random.Random(seed)
    if target.structure is not None and (target.structured_only or rng.random() < _STRUCTURED):
        # What cannot be taken apart may raise or warn in many ways.
        with contextlib.suppress(Exception), warnings.catch_warnings(action="ignore"):
            return target.structure(rng, bytes(data))[:longest]
    return atheris.Mutate(data, longest)


def _guide_by(owners: Sequence[Any]) -> None:
    """Let atheris count the branches of functions and of the methods of classes."""
    wanted = set(code_objects(owners))
    for owner in owners:
        for item in vars(owner).values() if isinstance(owner, type) else (owner,):
            function = getattr(item, "__func__", item)
            if isinstance(function, types.FunctionType) and function.__code__ in wanted:
                atheris.instrument_func(function)


def _outcome(target: Target, own: Path, exit_code: int | None) -> Outcome:
    """What libFuzzer left. Lines are counted where nothing failed only: an input may end this process, too."""
    log = (own / "log").read_text(errors="replace")
    number = {name: int(value) for name, value in re.findall(r"^stat::(\w+): +(\d+)$", log, re.MULTILINE)}
    outcome = Outcome(target.name, number.get("number_of_executed_units", 0), peak_mib=number.get("peak_rss_mb", 0))
    saved = [path for path in own.iterdir() if path.name.startswith(("crash-", "timeout-", "oom-"))]
    if saved or exit_code:
        raised = re.search(r"=== Uncaught Python exception: ===\n(.*)", log)
        outcome.fault = raised.group(1)[:300] if raised else f"the process ended with {exit_code}, see {own / 'log'}"
        outcome.input_path = str(saved[0]) if saved else ""
        return outcome
    lines = lines_of(target.code)
    paths = sorted((own / "corpus").iterdir())
    missing = lines - lines_reached(target.code, target.run, (path.read_bytes() for path in paths))
    outcome.lines, outcome.missing = len(lines), [f"{Path(file).name}:{line}" for file, line in sorted(missing)]
    return outcome


def _pages_held(column: int) -> int:
    """Memory pages of this process: column 0 of addresses, 1 resident."""
    return int(Path("/proc/self/statm").read_text().split()[column])


def _limit_memory() -> None:
    limit = _pages_held(0) * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
