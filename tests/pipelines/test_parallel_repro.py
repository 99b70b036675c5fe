"""Parallel stages: order of the DVC graph, number of jobs, failures and signals."""

import json
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from hoidata.errors import BadInput
from hoidata.files.atomic import exclusive
from pipelines.parallel_repro import (
    CODE,
    LOGS,
    RUN,
    RWLOCK,
    Plan,
    Run,
    RunStage,
    _signal_group,
    describe_plan,
    describe_run,
    forget_broken_lock,
    log_of,
    reproduce_in_parallel,
    run_all,
    stale_stages,
)
from pipelines.repro import steps_growth
from pipelines.sidecar import RUNS

PROJECT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # DVC's own libraries
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
# d needs b and c, which need a: b and c can run in parallel. e is independent.
GRAPH = {"a": [], "b": ["a"], "c": ["a"], "d": ["b", "c"], "e": []}


class Recorder:
    """Runs nothing; records when each stage begins and ends, and the number of parallel stages."""

    def __init__(self, failing: frozenset[str] = frozenset()) -> None:
        self.failing, self.events, self.at_work, self.most = failing, [], 0, 0
        self.lock = threading.Lock()

    def __call__(self, name: str) -> int:
        with self.lock:
            self.at_work += 1
            self.most = max(self.most, self.at_work)
            self.events.append(("begin", name))
        time.sleep(0.002)
        with self.lock:
            self.at_work -= 1
            self.events.append(("end", name))
        return int(name in self.failing)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def run_graph(upstream: dict[str, frozenset[str]], jobs: int, recorder: RunStage) -> Run:
    run = Run(seconds={CODE: 0.0})
    with ThreadPoolExecutor(jobs) as pool:
        run_all(upstream, pool, jobs, recorder, run)
    return run


@st.composite
def graphs(draw):
    """Any graph without a circle: each stage needs some of those named before it."""
    names = [f"s{number}" for number in range(draw(st.integers(1, 12)))]
    picks = [draw(st.sets(st.sampled_from(names[:index]))) if index else set() for index in range(len(names))]
    return dict(zip(names, map(frozenset, picks), strict=True))


@settings(max_examples=40, deadline=None)
@given(graphs(), st.integers(1, 4))
def test_every_stage_runs_once_after_its_inputs_within_the_number_of_jobs(upstream, jobs):
    recorder = Recorder()
    run_graph(upstream, jobs, recorder)
    assert sorted(name for event, name in recorder.events if event == "begin") == sorted(upstream)
    for name, needs in upstream.items():
        begin = recorder.events.index(("begin", name))
        assert all(recorder.events.index(("end", need)) < begin for need in needs)
    assert recorder.most <= jobs


@settings(max_examples=40, deadline=None)
@given(graphs(), st.data())
def test_a_failure_stops_its_dependents_and_nothing_else(upstream, data):
    failing = data.draw(st.sampled_from(sorted(upstream)))
    recorder = Recorder(frozenset({failing}))
    run = run_graph(upstream, 2, recorder)
    lost = {failing}
    for name, needs in upstream.items():  # in topological order
        if needs & lost:
            lost.add(name)
    assert set(run.seconds) == set(upstream) - lost | {failing, CODE}
    assert list(run.failed) == [failing]
    assert failing in describe_run(run)


def test_a_plan_lists_each_stage_with_the_minutes_of_its_last_run_or_of_its_kind():
    RUNS.mkdir(parents=True)
    for stage, seconds, ended in (("a@x", 120, "complete"), ("a@y", 240, "complete"), ("b@x", 6, "failed")):
        (RUNS / f"{stage}.json").write_text(json.dumps({"stage": stage, "seconds": seconds, "ended": ended}))
    (RUNS / "c@x.json").write_text("{")
    upstream = {"a@x": frozenset(), "a@z": frozenset(), "b@x": frozenset({"a@x", "a@z"})}
    assert describe_plan(Plan(upstream, frozenset({"a@x", "a@z"})), jobs=2).splitlines() == [
        "  2.0 min  a@x",
        "  3.0 min  a@z",
        "        ?  b@x  (if its inputs change)",
        "3 stages: 5.0 min and 1 unknown, 3.0 min with 2 in parallel; 2 stages are certain: 5.0 min",
    ]
    halved = Plan({"a@x": frozenset()}, frozenset({"a@x"}), {"a@x": 0.5})
    assert describe_plan(halved, jobs=1).splitlines()[0] == "  1.0 min  a@x"


TRAIN_STAGE = """
stages:
  train:
    matrix: {{net: [a, b]}}
    cmd: train ${{item.net}}
    params: [train.seed, "train.ours.${{item.net}}", "train.{size}.${{item.net}}", other.yaml]
"""


@pytest.mark.parametrize("size", ["small", "full"])
def test_a_training_grows_with_its_steps(tmp_path, size):
    def sections(**steps):
        return {net: {"training": {"steps": count}} for net, count in steps.items()}

    (tmp_path / "dvc.yaml").write_text(TRAIN_STAGE.format(size=size))
    params = {"train": {"seed": 0, "ours": {**sections(a=7), "b": {"training": None}}, size: sections(a=50, b=300)}}
    (tmp_path / "params.yaml").write_text(json.dumps(params))
    last = {"train.seed": 0, "train.ours.a": {"training": {"steps": 9}}, f"train.{size}.a": sections(a=200)["a"]}
    lock = {"train@a": {"cmd": "train a", "params": {"params.yaml": last}}, "train@b": {"cmd": "train b"}}
    (tmp_path / "dvc.lock").write_text(json.dumps({"schema": "2.0", "stages": lock}))
    assert steps_growth(tmp_path, ["train@a", "train@b", "other"]) == {"train@a": 0.25}  # b's lock has no steps


def test_the_progress_of_a_running_training_is_repeated_once_per_line(monkeypatch, capfd):
    monkeypatch.setattr("pipelines.parallel_repro.PROGRESS_S", 0.01)
    LOGS.mkdir(parents=True)
    log_of("a").write_text("step 9 of 9, loss 1, 0:00:00 left\n")  # of an earlier run

    def train(name: str) -> int:
        time.sleep(0.05)
        log_of(name).write_text("> python\nstep 1 of 2, loss 3, 0:00:01 left\n")
        time.sleep(0.3)
        return 0

    run_graph({"a": frozenset()}, 1, train)
    assert capfd.readouterr().out.splitlines()[:-1] == ["    a: step 1 of 2, loss 3, 0:00:01 left"]


START = """
import signal
with open("imported", "a") as stream:
    stream.write("x")
if __name__ == "__main__":
    from pipelines.parallel_repro import reproduce_in_parallel
    signal.signal(signal.SIGINT, signal.default_int_handler)
    reproduce_in_parallel([], 2)
"""


def tiny_project(folder: Path, sleep: float = 0.0) -> Path:
    """A DVC project of GRAPH: each stage concatenates its inputs and its source file."""
    body = "import sys, time, pathlib; t = [pathlib.Path(p).read_text() for p in sys.argv[2:]]; "
    body += f"time.sleep({sleep}); pathlib.Path(sys.argv[1]).write_text('(' + ' '.join(t) + ')'); "
    body += "print('made', sys.argv[1])"
    (folder / "make.py").write_text(body)
    (folder / "code.txt").write_text("code")
    code = {"cmd": "cat code.txt > code", "wdir": "..", "always_changed": True, "outs": [{"code": {"cache": False}}]}
    (folder / "pipelines").mkdir()
    (folder / "pipelines/dvc.yaml").write_text(yaml.safe_dump({"stages": {"code": code}}))
    stages = {}
    for name, needs in GRAPH.items():
        (folder / f"{name}.src").write_text(name)
        deps = [f"{name}.src", *(f"{need}.out" for need in needs)]
        cmd = f"{sys.executable} make.py {name}.out {' '.join(deps)}"
        stages[name] = {"cmd": cmd, "deps": ["code", *deps], "outs": [{f"{name}.out": {"persist": True}}]}
    (folder / "dvc.yaml").write_text(yaml.safe_dump({"stages": stages}))
    subprocess.run([sys.executable, "-m", "dvc", "init", "--no-scm", "-q"], cwd=folder, check=True)
    (folder / ".hoidata").mkdir()
    return folder


@pytest.mark.long
def test_a_run_equals_dvc_repro_and_a_second_run_does_nothing(tmp_path):
    tiny_project(tmp_path)
    run = reproduce_in_parallel([], jobs=2)
    assert sorted(run.seconds) == sorted([CODE, *GRAPH])
    assert (tmp_path / "d.out").read_text() == "(d (b (a)) (c (a)))"
    assert "made d.out" in log_of("d").read_text()
    status = subprocess.run([sys.executable, "-m", "dvc", "repro"], capture_output=True, text=True)
    assert "Running stage 'd'" not in status.stdout
    assert list(reproduce_in_parallel([], jobs=2).seconds) == [CODE]
    with pytest.raises(BadInput, match="'x' not found"):
        reproduce_in_parallel(["x"], jobs=2)
    (tmp_path / "b.src").write_text("B")
    assert stale_stages([]) == Plan({"b": frozenset(), "d": frozenset("b")}, frozenset("b"))
    assert stale_stages(["c"]) == Plan({}, frozenset())
    assert stale_stages(["c"], force=True) == Plan({"c": frozenset()}, frozenset("c"))
    assert sorted(reproduce_in_parallel(["d"], jobs=1).seconds) == ["b", "d", CODE]
    assert sorted(reproduce_in_parallel(["b"], jobs=1, force=True).seconds) == ["b", CODE]
    assert "made b.out" in log_of("b").read_text()


@pytest.mark.long
def test_a_failure_is_reported_with_its_output_and_existing_outputs_stay(tmp_path, capfd):
    tiny_project(tmp_path)
    reproduce_in_parallel([], jobs=2)
    (tmp_path / "b.src").write_bytes(b"\xff\xfe")
    (tmp_path / "e.src").write_text("E")
    run = reproduce_in_parallel([], jobs=2)
    assert set(run.failed) == {"b"}
    assert (tmp_path / "b.out").read_text() == "(b (a))"
    assert (tmp_path / "e.out").read_text() == "(E)"
    assert "UnicodeDecodeError" in capfd.readouterr().err
    (tmp_path / "code.txt").unlink()
    assert reproduce_in_parallel([], jobs=2).failed == {CODE: 255}
    assert "code.txt" in capfd.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_stage_process_that_has_no_group_yet_or_has_ended_is_stopped_without_an_error(number):
    just_started = subprocess.Popen(["sleep", "60"])
    _signal_group(just_started.pid, number)
    assert just_started.wait(10) == -signal.SIGKILL
    _signal_group(just_started.pid, number)


@pytest.mark.long
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_stopping_a_run_stops_its_stages_and_the_next_run_completes(tmp_path, sent):
    tiny_project(tmp_path, sleep=20)
    (tmp_path / "start.py").write_text(START)
    process = subprocess.Popen([sys.executable, "start.py"], cwd=tmp_path, env={"PYTHONPATH": str(PROJECT)})
    while not log_of("a").is_file() or "make.py" not in log_of("a").read_text():
        time.sleep(0.1)
    with pytest.raises(BadInput, match="at work on it"):
        reproduce_in_parallel([], jobs=1)
    process.send_signal(sent)
    assert process.wait(timeout=15) != 0
    with exclusive(RUN, wait_s=0):
        assert not (tmp_path / "a.out").exists()
    assert (tmp_path / "imported").read_text() == "x", "a stage imports what the run was started with, as Prefect"
    (tmp_path / "make.py").write_text((tmp_path / "make.py").read_text().replace("time.sleep(20)", "None"))
    assert reproduce_in_parallel([], jobs=2).failed == {}


@pytest.mark.slow
@pytest.mark.parametrize("left", ["", '{"write": {"a.out": {"pid": 1,', "[]"])
def test_an_incomplete_lock_of_a_killed_process_does_not_stop_later_runs(tmp_path, monkeypatch, left):
    monkeypatch.chdir(tmp_path)
    tiny_project(tmp_path)
    RWLOCK.parent.mkdir(parents=True, exist_ok=True)
    RWLOCK.write_text(left)
    assert reproduce_in_parallel([], jobs=2).failed == {}
    assert (tmp_path / "a.out").exists()


def test_a_complete_lock_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    RWLOCK.parent.mkdir(parents=True)
    RWLOCK.write_text('{"write": {}, "read": {"a": [{"pid": 1, "cmd": "dvc"}]}}')
    forget_broken_lock()
    assert '"pid": 1' in RWLOCK.read_text()
