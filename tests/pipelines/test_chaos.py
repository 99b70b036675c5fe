"""Interrupted runs and damaged files: existing outputs stay, the message has a remedy, the next run completes.

`make chaos` runs all cases three times; `make test` runs the cheap ones once.
"""

import contextlib
import json
import os
import random
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput, MachineError, explain_machine_errors
from hoidata.files.written import verify_with
from pipelines.cli import app
from pipelines.lineage.locks import dvc_digest, written_digest
from pipelines.parallel_repro import log_of
from pipelines.stages.code import write_code
from tests.builders.folders import kept
from tests.hoidata.test_lifetime import is_at_work, until
from tests.pipelines.prefect_up import hoidata_up, wait_until

IS_CHAOS = "HOIDATA_CHAOS" in os.environ
REPETITIONS = range(int(os.environ.get("HOIDATA_CHAOS", "1")))
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]
repeated = pytest.mark.parametrize("repetition", REPETITIONS)
only_in_chaos = pytest.mark.skipif(not IS_CHAOS, reason="`make chaos` stages it")
in_namespace = pytest.mark.skipif(
    subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode != 0,
    reason="mounting is not allowed here",
)
STAGE = ("python", "-m", "pipelines.stages")
GRAB = ("--profile", "embedded", "--dataset", "grab")
CONVERT, CONTACT = "convert@embedded-grab", "contact@embedded-grab"
STAGES = {
    "convert": ("convert", *GRAB),
    "contact": ("contact", *GRAB),
    "train": ("train", *GRAB, "--model", "contact"),
    "sample": ("sample", *GRAB, "--family", "text2hoi"),
}
OUTPUTS = ("data/embedded", "checkpoints/embedded", "samples/embedded", "metrics/embedded", "report/embedded")
EDITED: dict[Path, str] = {}  # used by a running test, with the digests before it


@pytest.fixture(autouse=True)
def _kept(built) -> Iterator[None]:
    """Check that all outputs have the same digests before and after each test."""
    before = outputs(built)
    assert len(before) == len(OUTPUTS)
    yield
    assert outputs(built) == before
    if EDITED:  # a checkpoint's header has the code of all stages behind it
        for path, text in EDITED.items():
            path.write_text(text)
        EDITED.clear()
        write_code(built)


def outputs(project: Path) -> dict[str, str | None]:
    """Digests of the outputs, as DVC computes them: without unfinished files of a killed run."""
    return {name: dvc_digest(project / name) for name in OUTPUTS}


@pytest.fixture
def typed(built, project_tools):
    """A function that runs a command and returns its result; fails if there is a traceback."""

    def run(*command: str, **more) -> subprocess.CompletedProcess:
        done = subprocess.run(
            command, cwd=built, env=project_tools.environment(), capture_output=True, text=True, timeout=300, **more
        )
        assert "Traceback" not in done.stderr + done.stdout, done.stderr + done.stdout
        return done

    return run


@pytest.fixture
def begun(built, project_tools):
    """A function that starts a command in a new process group, with stderr in stdout, and returns the process."""
    started: list[subprocess.Popen] = []

    def start(*command: str, **environment: str) -> subprocess.Popen:
        output = (built.parent / f"output-{len(started)}.log").open("w+b")
        process = subprocess.Popen(
            command,
            cwd=built,
            env=project_tools.environment(**environment),
            stdout=output,
            stderr=output,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        process.output = Path(output.name)  # pyright: ignore
        started.append(process)
        return process

    yield start
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def make_stale(project: Path, stage: str) -> None:
    """Make the stage stale without changing its result."""
    path = project / f"pipelines/stages/{stage}.py"
    EDITED.setdefault(path, path.read_text())
    path.write_text(f"{path.read_text()}# edited {time.time_ns()}\n")


def completes(typed, *targets: str) -> None:
    done = typed("hoidata", "repro", *targets)
    assert done.returncode == 0, done.stdout + done.stderr


def text_of(log: Path) -> str:
    return log.read_text(errors="replace") if log.is_file() else ""


def moment(repetition: int, least: float, most: float) -> float:
    return random.Random(repetition).uniform(least, most)


@pytest.mark.long
@repeated
@pytest.mark.parametrize("damage", ["absent", "changed", "one gone"] if IS_CHAOS else ["one gone"])
def test_absent_or_changed_raw_files_stop_a_conversion(built, typed, repetition, damage):
    raw, aside = built / ".hoidata/raw/embedded/grab", built / "aside"
    file = sorted(raw.glob("grab/*/*.npz"))[repetition]
    whole = file.read_bytes()
    if damage == "absent":
        shutil.move(raw, aside)
    elif damage == "changed":
        file.write_bytes(whole[:200] + bytes([whole[200] ^ 1]) + whole[201:])
    else:
        file.unlink()
    before = outputs(built)
    done = typed(*STAGE, *STAGES["convert"])
    assert done.returncode == 1
    remedy = {
        "absent": "hoidata synth write grab",
        "changed": "restore the file",
        "one gone": "1 gone, first",
    }
    assert remedy[damage] in done.stderr
    assert outputs(built) == before
    if damage == "absent":
        shutil.move(aside, raw)
    else:
        file.write_bytes(whole)
    assert typed(*STAGE, *STAGES["convert"]).returncode == 0


@only_in_chaos
@repeated
@pytest.mark.parametrize("stage", ["convert", "contact", "train", "sample"])
def test_a_killed_stage_leaves_its_old_output(built, typed, begun, repetition, stage):
    process = begun(*STAGE, *STAGES[stage], HOIDATA_JOBS="2")
    time.sleep(moment(repetition, 0.5, 4))
    before = outputs(built)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert outputs(built) == before
    assert typed(*STAGE, *STAGES[stage]).returncode == 0


@only_in_chaos
@repeated
def test_a_killed_worker_does_not_change_the_result(built, begun, repetition):
    process = begun(*STAGE, *STAGES["convert"], HOIDATA_JOBS="2")
    parent = psutil.Process(process.pid)
    workers: list[psutil.Process] = []
    while process.poll() is None and len(workers) < 2:
        workers = [child for child in parent.children() if "spawn_main" in " ".join(child.cmdline())]
    time.sleep(moment(repetition, 0, 2))
    with contextlib.suppress(psutil.NoSuchProcess):
        workers[repetition % 2].kill()
    assert process.wait(120) == 0, process.output.read_text()  # pyright: ignore


@pytest.mark.long
@repeated
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL] if IS_CHAOS else [signal.SIGINT])
def test_the_stages_of_an_interrupted_or_killed_run_end_with_it(built, typed, begun, repetition, sent):
    make_stale(built, "convert")
    log = built / log_of(CONVERT)
    log.unlink(missing_ok=True)
    process = begun("hoidata", "repro", CONVERT)
    wait_until(lambda: "Running stage" in text_of(log), 60, process, process.output)
    time.sleep(moment(repetition, 0, 2))
    children = psutil.Process(process.pid).children(recursive=True)
    os.kill(process.pid, sent)
    code = process.wait(60)
    output = process.output.read_text()
    if sent != signal.SIGKILL:
        assert (code, "run it again" in output, "Traceback" in output) == (128 + sent, True, False), output
    # Otherwise stages continue although no process waits for them.
    until(lambda: not any(map(is_at_work, children)), 30)
    completes(typed, CONVERT)


@only_in_chaos
@repeated
@pytest.mark.parametrize("stage", ["convert", "contact", "train"])
def test_a_write_error_is_reported_and_leaves_the_old_outputs(built, typed, repetition, stage):
    """A limit on the file size simulates a full disk: writing stops, and a partial file remains."""
    most = (3_000, 30_000, 100_000)[repetition]
    before = outputs(built)
    done = typed(*STAGE, *STAGES[stage], preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)))
    assert (done.returncode, "room" in done.stderr) == (1, True), done.stderr
    assert outputs(built) == before
    assert typed(*STAGE, *STAGES[stage]).returncode == 0


@only_in_chaos
@in_namespace
@repeated
@pytest.mark.parametrize("stage", ["convert", "contact", "train"])
def test_a_full_disk_is_reported_and_leaves_the_old_outputs(built, typed, repetition, stage):
    """The folder of the outputs is a small file system that is almost full."""
    folder = "checkpoints/embedded/grab" if stage == "train" else "data/embedded/grab"
    script = f"""
        set -e
        room=$(( $(du -sk {folder} | cut -f1) + {(8, 24, 60)[repetition]} ))
        mount -t tmpfs -o size=${{room}}k none /mnt
        cp -a {folder}/. /mnt/
        mount --bind /mnt {folder}
        code=0
        {" ".join(STAGE)} {" ".join(STAGES[stage])} || code=$?
        find {folder} -name '.*' -prune -o -type f -print | sort | xargs md5sum > "$OUT"
        exit $code
    """
    listing = built.parent / "listing"
    before = subprocess.run(
        f"find {folder} -name '.*' -prune -o -type f -print | sort | xargs md5sum",
        shell=True, cwd=built, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    done = typed("unshare", "-m", "env", f"OUT={listing}", "sh", "-c", script)
    assert (done.returncode, "No space left" in done.stderr) == (1, True), done.stderr
    assert listing.read_text() == before
    assert typed(*STAGE, *STAGES[stage]).returncode == 0


@only_in_chaos
@in_namespace
@repeated
def test_an_unwritable_cache_is_reported_before_any_stage_runs(built, typed, repetition):
    make_stale(built, "contact")
    before = outputs(built)
    script = "mount --bind .dvc/cache .dvc/cache && mount -o remount,ro,bind .dvc/cache && hoidata repro " + CONTACT
    done = typed("unshare", "-m", "sh", "-c", script)
    assert (done.returncode, "allow writing there" in done.stderr) == (1, True), done.stderr
    assert "contact" not in done.stdout
    assert outputs(built) == before
    completes(typed, CONTACT)


@only_in_chaos
@repeated
def test_a_second_run_in_parallel_is_refused_and_the_first_completes(built, typed, begun, repetition):
    make_stale(built, "convert")
    first = begun("hoidata", "repro", CONVERT)
    wait_until(lambda: (built / ".hoidata/.repro.lock").is_file(), 60, first, first.output)
    time.sleep(moment(repetition, 0.5, 2))
    os.kill(first.pid, signal.SIGSTOP)  # otherwise it may end before the second starts
    second = typed("hoidata", "repro", CONVERT)
    os.kill(first.pid, signal.SIGCONT)
    assert (second.returncode, "wait for that run to end" in second.stderr) == (1, True), second.stderr
    stage = typed(*STAGE, *STAGES["convert"])  # the same stage from the command line, which may start before or after
    assert stage.returncode == 0 or "at work on it" in stage.stderr
    assert first.wait(120) == 0, first.output.read_text()
    completes(typed, CONVERT)


@only_in_chaos
@repeated
@pytest.mark.parametrize("killed", ["server", "hoidata up"])
def test_without_the_prefect_server_outputs_stay_and_a_run_from_the_command_line_completes(
    built, project_tools, typed, repetition, killed
):
    make_stale(built, "convert")
    with hoidata_up(built, project_tools) as up:
        started = project_tools.run(built, "prefect", "deployment", "run", "convert-grab", **up.settings)
        assert started.returncode == 0, started.stdout + started.stderr
        log = built / log_of(CONVERT)
        log.unlink(missing_ok=True)
        wait_until(
            lambda: log.is_file() and "Running stage" in log.read_text(errors="replace"), 120, up.process, up.log
        )
        time.sleep(moment(repetition, 0, 2))
        children = psutil.Process(up.process.pid).children(recursive=True)
        if killed == "server":
            for child in (one for one in psutil.Process(up.process.pid).children() if "server" in one.cmdline()):
                child.kill()
        else:
            up.process.kill()
        time.sleep(2)
    _, alive = psutil.wait_procs(children, 30)
    assert not alive, "a worker and a flow run obey the next server at the address"
    completes(typed, CONVERT)


def flipped(data: bytes, repetition: int) -> bytes:
    """Flip one bit in the middle of a file."""
    index = len(data) // 2 + repetition
    return data[:index] + bytes([data[index] ^ 1 << repetition % 8]) + data[index + 1 :]


DAMAGED = {
    "an array": ("data/embedded/grab/clips/arrays/frames-00000.npz", ["info", "data/embedded/grab/clips"]),
    "a table": ("data/embedded/grab/clips/meta/sequences.parquet", ["info", "data/embedded/grab/clips"]),
    "facts": ("data/embedded/grab/clips/meta/info.json", ["info", "data/embedded/grab/clips"]),
    "words": ("data/embedded/grab/annotation/text.parquet", ["show", "grab"]),
    "a checkpoint": ("checkpoints/embedded/grab/contact/model.safetensors", ["validate", "checkpoints/embedded/grab"]),
    "figures": ("metrics/embedded/grab/text2hoi.json", ["table", "metrics/embedded/grab", "--metrics", "contact_f1"]),
}


@repeated
@pytest.mark.parametrize("kind", DAMAGED)
def test_one_changed_byte_is_reported_by_validate_and_check_and_refused_by_readers(
    built, monkeypatch, repetition, kind
):
    monkeypatch.chdir(built)
    name, reader = DAMAGED[kind]
    path = built / name
    whole = path.read_bytes()
    path.write_bytes(flipped(whole, repetition))
    verify_with(written_digest)
    try:
        for words in (["validate", str(path.parent)], ["lineage", "check", str(path)]):
            done = CliRunner().invoke(app, words, env={"COLUMNS": "400"})
            assert done.exit_code == 1, done.output
            assert path.name in done.output.replace("\n", "")
        done = CliRunner().invoke(app, reader)
        if kind != "an array":
            assert done.exit_code == 1
            assert isinstance(done.exception, BadInput | SystemExit), done.exception
        else:  # `info` opens no array; a clip is refused
            from hoidata.store.store import open_store

            store = open_store(path.parents[1])
            with pytest.raises(BadInput, match="checksum"):
                store.clip(store.ids[0])
    finally:
        verify_with(lambda path: None)
        path.write_bytes(whole)


def test_a_missing_entry_of_a_json_file_is_reported_with_its_name_and_the_file(built):
    from hoidata.store.store import open_store

    path = built / "data/embedded/grab/clips/meta/info.json"
    with kept(path) as whole:
        path.write_text(json.dumps({key: value for key, value in json.loads(whole).items() if key != "counts"}))
        with pytest.raises(BadInput, match=r"info\.json: counts"):
            open_store(path.parents[1])


@pytest.mark.long
def test_file_names_that_are_not_utf_8_give_a_message_instead_of_a_traceback(built, typed, tmp_path):
    for words in (["validate"], ["lineage"], ["generate", "Lift it.", "--out", "out", "--object"])[not IS_CHAOS :]:
        done = typed("hoidata", *words, os.fsdecode(b"b\xffd.obj"))
        assert done.returncode in (1, 2)
        assert "d.obj" in done.stderr
    raw = tmp_path / "raw"
    shutil.copytree(built / ".hoidata/raw/embedded/grab", raw)
    sequence = sorted(raw.glob("grab/s1/*.npz"))[0]
    shutil.copy(sequence, os.fsencode(sequence.parent) + b"/m\xffg_lift_9.npz")
    code = f"""
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.hands import load_embedded_hands
done = convert_dataset(GrabAdapter(), {str(raw)!r}, load_embedded_hands(), {str(tmp_path / "out")!r}, progress=False)
print(done.clips, len(done.quarantined), done.quarantined[0].remedy)
"""
    done = typed(sys.executable, "-c", code)
    clips = len(list(raw.glob("grab/*/*.npz"))) - 1
    assert done.stdout == f"{clips} 1 rename it\n", done.stdout + done.stderr


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device", "a"), "make some"),
        (OSError("1000 requested and 12 written"), "make some"),
        (RuntimeError("I/O error: File too large (os error 27)"), "make some"),
        (sqlite3.OperationalError("disk I/O error"), "no room, or it cannot be written"),
        (OSError(30, "Read-only file system", "a"), "allow writing there"),
        (OSError(5, "Input/output error", "a"), "the disk fails"),
        (MemoryError("Unable to allocate 7 GiB"), "lower --jobs"),
    ],
)
def test_machine_errors_have_a_remedy_and_other_errors_are_raised(error, words):
    with pytest.raises(MachineError, match=words), explain_machine_errors():
        raise error
    for defect in (FileNotFoundError(2, "No such file", "a"), ValueError("disk")):
        with pytest.raises(type(defect)), explain_machine_errors():
            raise defect
