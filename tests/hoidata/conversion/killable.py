"""Conversions that can be killed at a chosen moment. As a program it is a server that reads one JSON order per line.

Each order is a conversion in a new process group. Its workers import this file, so they also die at the call that
``KILL_AT`` states: at the n-th rename, after it, or with half of an array file written.
"""

import io
import json
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import HoidataError
from hoidata.files import arrays as arrays_file
from hoidata.hands import load_embedded_hands

KILL_AT = "HOIDATA_TEST_KILL_AT"
LOADED = "HOIDATA_TEST_LOADED"
DEADLY = "HOIDATA_TEST_DEADLY"  # the name of a sequence that kills the process that converts it
N_FRAMES = 40
IS_WORKER = __name__ == "__mp_main__"  # the name of the main module in a spawned process


def write_grab(root: Path, hands, n_sequences: int, n_frames: int = N_FRAMES, fps: int = 120) -> None:
    """Write alternating sequences of two subjects and two objects in GRAB's format; contact begins at frame 12."""
    write_meshes(root, hands)
    for number in range(n_sequences):
        name = f"s{number % 2 + 1}/{('mug', 'bowl')[number % 2]}_lift_{number:03d}"
        write_sequence(root, name, number, n_frames, fps)


def write_meshes(root: Path, hands) -> None:
    meshes = root / "tools" / "meshes"
    meshes.mkdir(parents=True)
    for side in ("left", "right"):
        lines = [f"v {x} {y} {z}" for x, y, z in hands[side].template_m]
        faces = [f"f {a} {b} {c}" for a, b, c in hands[side].faces + 1]
        (meshes / f"{side}.obj").write_text("\n".join(lines + faces))
    for name, size in (("mug", 0.1), ("bowl", 0.2)):
        corners = f"v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\n"
        (meshes / f"{name}.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")


def write_sequence(
    root: Path, name: str, seed: int, n_frames: int = N_FRAMES, fps: int = 120, first_touched: int = 12
) -> None:
    """Write one sequence with random numbers. name: subject/object_intent, as in GRAB."""
    rng, path = np.random.default_rng(seed), root / "grab" / f"{name}.npz"
    mesh, intent = path.stem.split("_")[:2]
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {"global_orient": 3, "transl": 3, "fullpose": 45}
    blocks: dict = {
        member: {"params": {name: rng.normal(size=(n_frames, width)) for name, width in columns.items()}}
        for member in ("lhand", "rhand", "object")
    }
    blocks["rhand"]["vtemp"], blocks["lhand"]["vtemp"] = "tools/meshes/right.obj", "tools/meshes/left.obj"
    blocks["object"]["object_mesh"] = f"tools/meshes/{mesh}.obj"
    touched = np.arange(n_frames) >= first_touched
    blocks["contact"] = {"object": np.repeat(touched[:, None], 4, axis=1).astype(np.int8)}
    objects = {key: np.array(block, dtype=object) for key, block in blocks.items()}
    np.savez(path, obj_name=mesh, motion_intent=intent, framerate=fps, n_frames=n_frames, **objects)


@dataclass(frozen=True)
class LoggedGrab(GrabAdapter):
    """Logs each sequence it loads, and waits 10 ms so that there is time for a kill."""

    def load(self, raw, key, hands):
        with open(os.environ[LOADED], "a") as log:
            log.write(f"{key.name}\n")
        if key.name == os.environ.get(DEADLY):
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.01)
        return super().load(raw, key, hands)


def die_at(order: dict | None) -> dict[str, int]:
    """Make this process kill itself or its group at the n-th call of the operation that the order names.

    The operation is "rename" (die before it), "renamed" (die after it) or "write" (die with half of a file written).

    Returns:
        A dictionary whose entry "count" is the number of calls so far.
    """
    calls = {"count": 0}
    if not order or order.get("only") not in (None, "worker" if IS_WORKER else "parent"):
        return calls
    replace, write_arrays = os.replace, arrays_file.write_npz_to

    def is_the_one() -> bool:
        calls["count"] += 1
        return calls["count"] == order["n"]

    def die() -> None:
        os.killpg(0, signal.SIGKILL) if order["who"] == "group" else os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60)

    def dying_replace(source, target) -> None:
        now = is_the_one()
        if now and order["at"] == "rename":
            die()
        replace(source, target)
        if now:
            die()

    def dying_write(stream, arrays) -> None:
        if is_the_one():
            whole = io.BytesIO()
            write_arrays(whole, arrays)
            stream.write(whole.getvalue()[: len(whole.getvalue()) // 2])
            stream.flush()
            die()
        write_arrays(stream, arrays)

    if order["at"] == "write":
        arrays_file.write_npz_to = dying_write
    else:
        os.replace = dying_replace
    return calls


if IS_WORKER:
    die_at(json.loads(os.environ[KILL_AT]))


def run(order: dict) -> int:
    """Run one conversion. Returns the exit code; on an error 1, with the message on stderr."""
    try:
        convert_dataset(
            LoggedGrab(**order.get("settings", {})),
            order["root"],
            load_embedded_hands(),
            order["out"],
            jobs=order["jobs"],
            progress=False,
        )
    except HoidataError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def start(order: dict) -> int:
    """Run the order in a new process group. Returns its id."""
    child = os.fork()
    if child:
        return child
    os.setsid()
    os.dup2(os.open(order["stderr"], os.O_CREAT | os.O_WRONLY | os.O_TRUNC), 2)
    os.environ[LOADED], os.environ[KILL_AT] = order["loaded"], json.dumps(order.get("kill"))
    os.environ[DEADLY] = order.get("deadly", "")
    calls = die_at(order.get("kill"))
    code = run(order)
    Path(order["counted"]).write_text(str(calls["count"]))
    os._exit(code)


def serve() -> None:
    for line in sys.stdin:
        order = json.loads(line)
        loaded = Path(order["loaded"])
        loaded.write_text("")
        child = start(order)
        if "after_s" in order:  # counted from the first sequence
            while not loaded.stat().st_size:
                time.sleep(0.001)
            time.sleep(order["after_s"])
            target = os.killpg if order["who"] == "group" else os.kill
            target(child, order["signal"])
        begun = time.monotonic()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps({"status": status, "ended_s": time.monotonic() - begun}), flush=True)


if __name__ == "__main__":
    # A test run in the background of a script may ignore Ctrl-C, and its children would too.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    serve()
