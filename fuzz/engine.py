"""Fuzzing of one parser by atheris (libFuzzer), in this process, which libFuzzer ends.

A fault is an exception other than BadInput and MissingResource, or a warning. A call over one second of processor time,
a timeout of 30 s, and an allocation over 1 GiB above the initial memory are faults too. The first fault ends the run,
and libFuzzer saves its input.
"""

import contextlib
import io
import pickletools
import random
import resource
import shutil
import time
import warnings
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import atheris

from hoidata.errors import BadInput, MissingResource

MAX_CALL_S = 1.0
HANG_S = 30
MEMORY_BYTES = 1 << 30
MAX_INPUT_BYTES = 1 << 14
OPCODES = (
    *(opcode.code.encode("latin1") for opcode in pickletools.opcodes if opcode.arg is None),
    *(b"cnumpy\nndarray\n", b"cnumpy\ndtype\n", b"cnumpy.core.multiarray\n_reconstruct\n", b"cos\nsystem\n"),
    *(b"c_codecs\nencode\n", b"cbuiltins\nset\n", b"cchumpy.ch\nCh\n", b"cscipy.sparse.csc\ncsc_matrix\n"),
    *(b"ctorch._utils\n_rebuild_tensor_v2\n", b"ctorch.storage\n_load_from_bytes\n", b"ccollections\nOrderedDict\n"),
    *(b"K\x05", b"J\xff\xff\xff\xff", b"h\x00", b"q\x00", b"r\xff\xff\xff\x7f", b"U\x02O8", b"X\x02\0\0\0f8", b"I-1\n"),
)
WORDS = (
    b"-1", b"255", b"65536", b"2147483648", b"9223372036854775807", b"18446744073709551616", b"1e308", b"1e999",
    b"-1e999", b"nan", b"NaN", b"inf", b"1_0", b"0x10", b"null", b"true", b"\\ud800", b"\xff", b"\0", b"\xd9\xa3",
    b"'descr': '|O'", b"(1000000000, 1000000000)", b"<f8", b"<U3", b"()", b"(-1,)", b".npy", b"PK\x01\x02",
    b"1/2/3", b"//", b"\\\n", b"element face 1000000000\n", b"property list uchar int vertex_indices\n",
    b"end_header\n", b"[roots]\n", b"'''", b"[[a]]\n", b"a.b.c = 1\n", b"!!python/object/apply:os.system ",
    b"&a ", b"*a", b"<<: *a\n",
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """One parser to fuzz."""

    seeds: Callable[[], Sequence[bytes]]  # returns small valid files
    run: Callable[[bytes, Path], Any]  # parses bytes; may write into the folder
    modules: Sequence[ModuleType] = ()  # whose branches guide the search
    # "zip" or "pickle": members or opcodes are mutated one by one, so that lengths and checksums stay valid.
    container: str = ""


def fuzz(name: str, target: Target, seed: int, executions: int, seconds: int, folder: Path) -> None:
    """Run one target until either limit; the corpus and a failing input are written into ``folder``."""
    target_folder = folder.resolve() / name
    shutil.rmtree(target_folder, ignore_errors=True)
    for part in ("corpus", "scratch"):
        (target_folder / part).mkdir(parents=True)
    seeds = target.seeds()
    for number, data in enumerate(seeds):
        (target_folder / "corpus" / f"seed-{number:03d}").write_bytes(data)
    words = ("".join(f"\\x{byte:02x}" for byte in word) for word in (*WORDS, *OPCODES))
    (target_folder / "words").write_text("".join(f'"{word}"\n' for word in words))
    for module in target.modules:
        _instrument(module, module.__name__)
    options = {
        "runs": executions, "max_total_time": seconds, "seed": seed + 1, "timeout": HANG_S, "rss_limit_mb": 0,
        "max_len": max(MAX_INPUT_BYTES, *map(len, seeds)), "print_final_stats": 1,
        "artifact_prefix": f"{target_folder}/", "dict": target_folder / "words",
    }  # fmt: skip
    arguments = [name, *(f"-{option}={value}" for option, value in options.items()), str(target_folder / "corpus")]
    mutate = CONTAINERS.get(target.container)
    mutator = {"custom_mutator": lambda *mutation: _mutated(mutate, *mutation)} if mutate else {}
    atheris.Setup(arguments, lambda data: check_call(target, data, target_folder / "scratch"), **mutator)
    initial_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (initial_bytes + MEMORY_BYTES,) * 2)
    warnings.simplefilter("error")  # a warning is a fault too
    atheris.Fuzz()


def check_call(target: Target, data: bytes, folder: Path) -> None:
    """Run the parser once. An exception of this function is a fault."""
    begin = time.process_time()
    try:
        target.run(data, folder)
    except (BadInput, MissingResource) as error:
        if "MemoryError" in str(error):
            raise
    if time.process_time() - begin > MAX_CALL_S:
        raise TimeoutError(f"{time.process_time() - begin:.2f} s")


def _instrument(owner: Any, module: str) -> None:
    """Let atheris count the branches of a module's functions and of its classes' methods."""
    for value in list(vars(owner).values()):
        value = getattr(value, "__func__", value)
        if getattr(value, "__module__", "") != module:
            continue
        if isinstance(value, type):
            _instrument(value, module)
        elif isinstance(value, FunctionType) and value.__code__.co_filename.endswith(".py"):
            atheris.instrument_func(value)


Change = Callable[[random.Random, bytes, int], bytes]


def _mutated(change: Change, data: bytes, longest: int, seed: int) -> bytes:
    rng = random.Random(seed)
    if rng.random() < 0.6:
        # An input that is not a valid container may raise or warn in many ways.
        with contextlib.suppress(Exception), warnings.catch_warnings(action="ignore"):
            return change(rng, bytes(data), longest)[:longest]
    return atheris.Mutate(data, longest)


def change_zip(rng: random.Random, data: bytes, longest: int) -> bytes:
    """Change, remove, repeat or rename one member."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        items = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
    index = rng.randrange(len(items))
    name, content, compression = items.pop(index)
    names = [name] * 5 + ["x.npy", "../up.npy", "/abs.npy", name + "/", "a" * 300]
    changed = (rng.choice(names), atheris.Mutate(content, longest), compression)
    items[index:index] = rng.choice(([], [(name, content, compression)] * 2, [changed], [changed], [changed]))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content, compression in items:
            archive.NameToInfo.clear()  # zipfile warns about a repeated name
            archive.writestr(zipfile.ZipInfo(name), content, compression)  # a ZipInfo has a fixed time
    return stream.getvalue()


def change_pickle(rng: random.Random, data: bytes, longest: int) -> bytes:
    """Remove, repeat, exchange or replace whole opcodes; FRAME opcodes are dropped, because they contain lengths."""
    starts = [(opcode.name, position) for opcode, _, position in pickletools.genops(data)]
    stops = [position for _, position in starts[1:]] + [starts[-1][1] + 1]
    parts = [data[start:stop] for (name, start), stop in zip(starts, stops, strict=True) if name != "FRAME"]
    for _ in range(rng.choice((1, 1, 2, 4))):
        index, other = rng.randrange(len(parts)), rng.randrange(len(parts))
        new = ([], [parts[index]] * 2, [parts[other]], [rng.choice(OPCODES)], [atheris.Mutate(parts[index], longest)])
        parts[index : index + 1] = rng.choice(new)
    return b"".join(parts) + data[stops[-1] :]


CONTAINERS: dict[str, Change] = {"zip": change_zip, "pickle": change_pickle}
