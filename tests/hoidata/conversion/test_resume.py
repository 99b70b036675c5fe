"""After a kill at any moment, the next run reuses the finished sequences and writes the same bytes.

``HOIDATA_KILLS=20`` sets the number of random kills; the default is 3.
"""

import hashlib
import importlib.util
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import hoidata
from hoidata.conversion.convert import convert_dataset
from hoidata.errors import BadInput
from hoidata.files.atomic import exclusive
from hoidata.store.store import open_store
from pipelines.lineage.manifests import scan_files
from tests.hoidata.conversion import killable

pytestmark = [pytest.mark.first, pytest.mark.long]
DRIVER = Path(__file__).with_name("killable.py")
N_SEQUENCES = 24
KILLS = int(os.environ.get("HOIDATA_KILLS", 3))
# Operation to die at, and its position: a fraction of a run's renames or writes, or counted back from the last (-1).
IN_A_WRITE = (("rename", 0.1), ("write", 0.05), ("write", 0.25), ("write", 0.5), ("renamed", 0.6), ("write", -1))
AT_THE_END = (("rename", -3), ("rename", -2), ("renamed", -2), ("rename", -1), ("renamed", -1))


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


class Conversions:
    """A server process that runs conversions, the raw folder, and the digests of an undisturbed run."""

    def __init__(self, folder: Path, hands) -> None:
        self.folder, self.root = folder, folder / "raw"
        killable.write_grab(self.root, hands, N_SEQUENCES)
        self.process = subprocess.Popen(
            [sys.executable, str(DRIVER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.run(folder / "undisturbed" / "clips")
        self.expected = digests(folder / "undisturbed" / "clips")

    def run(self, out: Path, jobs: int = 1, **options) -> SimpleNamespace:
        """Run one conversion. Returns exit status, loaded sequences, stderr and the time until it ended."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        loaded, stderr_file = self.folder / "loaded.txt", self.folder / "stderr.txt"
        log_files = {"loaded": str(loaded), "stderr": str(stderr_file), "counted": str(self.folder / "counted.txt")}
        order = {"root": str(self.root), "out": str(out), "jobs": jobs, **log_files}
        self.process.stdin.write(json.dumps(order | options) + "\n")
        self.process.stdin.flush()
        answer = json.loads(self.process.stdout.readline())
        return SimpleNamespace(**answer, loaded=loaded.read_text().split(), stderr=stderr_file.read_text())

    def moment(self, out: Path, operation: str, position: float, only: str | None = None, **more) -> int:
        """The number of the call to die at, counted in an equal run without a kill."""
        self.run(out, kill={"at": operation, "n": -1, "who": "group", "only": only}, **more)
        total = int((self.folder / "counted.txt").read_text())
        return total + 1 + int(position) if position < 0 else int(position * total)

    def kill_and_run_again(self, out: Path, jobs: int = 1, **options) -> SimpleNamespace:
        """Kill one run and check that a second one, without workers, completes it. Returns the killed run."""
        killed = self.run(out, jobs, **options)
        finished = self.finished(out)
        second_run = self.run(out)
        assert second_run.status == 0, second_run.stderr
        assert digests(out) == self.expected
        assert os.listdir(out.parent) == ["clips"]
        # Workers that outlive their parent may each finish one more sequence after the count.
        orphans = jobs if options.get("who") == "parent" else 0
        missing = N_SEQUENCES - finished
        assert len(second_run.loaded) == len(set(second_run.loaded))
        assert missing - orphans <= len(second_run.loaded) <= missing
        return killed

    @staticmethod
    def finished(out: Path) -> int:
        return len(list((out.parent / ".clips.work" / "sequences").glob("[!.]*.npz")))

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(20)
        self.process.stdout.close()


@pytest.fixture(scope="module")
def conversions(tmp_path_factory):
    from hoidata.hands import load_embedded_hands

    server = Conversions(tmp_path_factory.mktemp("resume"), load_embedded_hands())
    yield server
    server.close()


@pytest.mark.parametrize(("at", "when"), IN_A_WRITE)
def test_a_kill_inside_a_write_or_rename_leaves_no_partial_file(conversions, tmp_path, at, when):
    kill = {"at": at, "n": conversions.moment(tmp_path / "counted" / "clips", at, when), "who": "group"}
    assert conversions.kill_and_run_again(tmp_path / "out" / "clips", kill=kill).status == -signal.SIGKILL


@pytest.mark.parametrize(("at", "when"), AT_THE_END)
def test_a_kill_while_an_old_store_is_replaced_leaves_the_old_or_the_new_one_complete(conversions, tmp_path, at, when):
    out = tmp_path / "out" / "clips"
    conversions.run(out, settings={"margin_frames": 2})
    before = digests(out)
    assert before != conversions.expected
    shutil.copytree(out, tmp_path / "counted" / "clips")
    kill = {"at": at, "n": conversions.moment(tmp_path / "counted" / "clips", at, when), "who": "group"}
    assert conversions.run(out, kill=kill).status == -signal.SIGKILL
    moved_aside = [path for path in out.parent.iterdir() if path.suffix == ".old"]
    assert digests(out) in (before, conversions.expected) or [digests(path) for path in moved_aside] == [before]
    conversions.run(out)
    assert digests(out) == conversions.expected
    assert os.listdir(out.parent) == ["clips"]


@pytest.mark.parametrize("number", range(KILLS))
def test_kills_at_random_moments_change_no_byte(conversions, tmp_path, number):
    after_s = random.Random(number).uniform(0, 0.7)
    jobs = 1 + (number % 4 == 0)
    killed = conversions.kill_and_run_again(
        tmp_path / "clips", jobs, after_s=after_s, signal=signal.SIGKILL, who="group"
    )
    assert killed.status in (-signal.SIGKILL, 0)


def test_a_worker_killed_once_changes_no_byte(conversions, tmp_path):
    done = conversions.run(tmp_path / "clips", jobs=2, kill={"at": "rename", "n": 10, "who": "self", "only": "worker"})
    assert (done.status, done.stderr) == (0, "")
    assert digests(tmp_path / "clips") == conversions.expected
    assert len(done.loaded) > N_SEQUENCES


def test_a_sequence_that_kills_its_worker_twice_is_quarantined_and_not_tried_again_on_resume(conversions, tmp_path):
    out, deadly = tmp_path / "clips", "s1/mug_lift_002"
    late = {"at": "rename", "n": -1, "who": "group", "only": "parent"}
    late["n"] = conversions.moment(out, "rename", -1, jobs=2, deadly=deadly, only="parent")
    assert (conversions.folder / "loaded.txt").read_text().split().count(deadly) == 2
    store, whole = open_store(out), open_store(conversions.folder / "undisturbed" / "clips")
    (quarantine_row,) = store.quarantine.to_dict("records")
    assert quarantine_row["source_key"] == f"grab/{deadly}"
    assert "SIGKILL" in quarantine_row["got"]
    assert store.ids == [clip_id for clip_id in whole.ids if deadly not in clip_id]
    expected = digests(out)
    assert conversions.run(tmp_path / "again" / "clips", 2, deadly=deadly, kill=late).status == -signal.SIGKILL
    resumed = conversions.run(tmp_path / "again" / "clips", jobs=1, deadly=deadly)
    assert (resumed.status, resumed.loaded) == (0, [])
    assert digests(tmp_path / "again" / "clips") == expected


def test_when_the_parent_alone_is_killed_its_workers_end_and_the_next_run_waits_for_them(conversions, tmp_path):
    out = tmp_path / "clips"
    conversions.kill_and_run_again(out, jobs=2, after_s=0.1, signal=signal.SIGKILL, who="parent")


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_ends_the_run_immediately_and_the_next_run_resumes(conversions, tmp_path, jobs):
    stopped = conversions.kill_and_run_again(tmp_path / "clips", jobs, after_s=0.1, signal=signal.SIGINT, who="group")
    assert stopped.status == 130
    assert stopped.ended_s < 10
    assert stopped.stderr == ""


class Broken(Exception):
    pass


@pytest.fixture
def half_done(tmp_path, hands, monkeypatch):
    """Raw files of six sequences, an adapter that logs loads, and a run that fails while the store is written."""
    root, out = tmp_path / "raw", tmp_path / "output" / "clips"
    killable.write_grab(root, hands, 6)
    monkeypatch.setenv(killable.LOADED, str(tmp_path / "loaded.txt"))

    def run(adapter=None, **options) -> list[str]:
        (tmp_path / "loaded.txt").write_text("")
        convert_dataset(
            adapter or killable.LoggedGrab(), root, options.pop("hands", hands), out, progress=False, **options
        )
        return (tmp_path / "loaded.txt").read_text().split()

    def break_off(**more) -> None:
        def broken(*_) -> None:
            raise Broken

        with monkeypatch.context() as patch:
            patch.setattr("hoidata.conversion.convert.write_store", broken)
            with pytest.raises(Broken):
                run(**more)

    return SimpleNamespace(root=root, out=out, run=run, break_off=break_off, tmp_path=tmp_path)


def test_finished_sequences_are_reused_and_the_summary_counts_them(half_done, hands, capsys):
    half_done.break_off()
    summary = convert_dataset(killable.LoggedGrab(), half_done.root, hands, half_done.out)
    assert summary.resumed == 6
    assert "6 sequences (6 finished before); 0 quarantined" in capsys.readouterr().out
    assert half_done.run() == [
        f"s{number % 2 + 1}/{('mug', 'bowl')[number % 2]}_lift_{number:03d}" for number in (0, 2, 4, 1, 3, 5)
    ]


def test_only_the_sequence_whose_source_changed_is_converted_again(half_done):
    half_done.break_off()
    path = half_done.root / "grab" / "s1" / "mug_lift_002.npz"
    data = path.read_bytes()
    path.write_bytes(data)
    assert half_done.run() == ["s1/mug_lift_002"]
    half_done.break_off()
    os.utime(half_done.root / "tools" / "meshes" / "bowl.obj")
    assert half_done.run() == ["s2/bowl_lift_001", "s2/bowl_lift_003", "s2/bowl_lift_005"]


def test_a_frame_file_rewritten_in_its_folder_is_a_change(tmp_path):
    from hoidata.conversion.finished import _stamp

    (tmp_path / "000000.txt").write_text("1 2 3")
    before = _stamp(tmp_path)
    assert _stamp(tmp_path) == before
    os.utime(tmp_path / "000000.txt", (1, 1))
    assert _stamp(tmp_path) != before


def test_a_file_added_next_to_the_sources_makes_them_be_read_again(half_done):
    half_done.break_off()
    (half_done.root / "grab" / "s1" / "note.txt").write_text("a file that an adapter might read")
    assert half_done.run() == ["s1/mug_lift_000", "s1/mug_lift_002", "s1/mug_lift_004"]


@pytest.mark.parametrize("changed_input", ["settings", "hands", "manifest", "synthetic", "schema", "code", "libraries"])
def test_no_sequence_is_reused_when_an_input_of_the_results_changed(half_done, hands, monkeypatch, changed_input):
    half_done.break_off()
    options: dict = {}
    if changed_input == "settings":
        options["adapter"] = killable.LoggedGrab(margin_frames=1)
    elif changed_input == "hands":
        thinner = replace(hands.right, template_m=hands.right.template_m * 0.99)
        options["hands"] = replace(hands, right=thinner)
    elif changed_input == "manifest":
        options["manifest"] = scan_files(half_done.root)
    elif changed_input == "synthetic":
        options["synthetic"] = True
    elif changed_input == "schema":
        monkeypatch.setattr("hoidata.conversion.finished.SCHEMA_VERSION", "1.99.0")
    elif changed_input == "code":
        monkeypatch.setattr("hoidata.conversion.finished._code_digest", lambda kind: "other code")
    else:
        monkeypatch.setattr("hoidata.conversion.finished.version", lambda name: "0.0")
    assert len(half_done.run(**options)) == 6


def test_the_digest_of_code_covers_hoidata_and_the_adapters_file(tmp_path):
    from hoidata.conversion.finished import CODE_PATHS, _code_digest

    assert all(Path(hoidata.__file__).with_name(name).exists() for name in CODE_PATHS)
    path = tmp_path / "foreign.py"
    text = "from hoidata.datasets.grab.adapter import GrabAdapter\nclass Foreign(GrabAdapter):\n    pass\n"

    def digest(more: str) -> str:
        path.write_text(text + more)
        spec = importlib.util.spec_from_file_location("foreign", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["foreign"] = module
        spec.loader.exec_module(module)
        return _code_digest(module.Foreign)

    assert digest("") == digest("") != digest("# changed\n")


def test_a_sequence_that_failed_is_tried_again(half_done):
    path = half_done.root / "grab" / "s1" / "mug_lift_002.npz"
    data = path.read_bytes()
    path.write_bytes(data[:100])
    half_done.break_off()
    assert half_done.run() == ["s1/mug_lift_002"]


def test_a_damaged_result_is_converted_again(half_done):
    half_done.run()
    whole = digests(half_done.out)
    half_done.break_off()
    for path in sorted((half_done.out.parent / ".clips.work" / "sequences").iterdir())[:2]:
        path.write_bytes(path.read_bytes()[:64])
    assert len(half_done.run()) == 2
    assert digests(half_done.out) == whole


def test_results_whose_mesh_is_missing_are_converted_again(half_done):
    half_done.run()
    whole = digests(half_done.out)
    half_done.break_off()
    shutil.rmtree(half_done.out.parent / ".clips.work" / "shared")
    assert len(half_done.run()) == 6
    assert digests(half_done.out) == whole


def test_meshes_and_personal_hands_are_saved_once_and_resumed_bytes_are_equal(half_done, hands):
    half_done.break_off()
    work = half_done.out.parent / ".clips.work"
    # two hand templates; vertices of mug and bowl; their faces and parts are equal
    assert len(list((work / "shared").iterdir())) == 6
    assert not [path for path in work.rglob("*") if path.suffix in (".pkl", ".pickle")]
    half_done.run()
    resumed_digests = digests(half_done.out)
    half_done.run()
    assert digests(half_done.out) == resumed_digests


def test_two_runs_never_write_one_store(half_done):
    message = rf"process {os.getpid()} at work.*wait for that run to end"
    with exclusive(half_done.out), pytest.raises(BadInput, match=message), exclusive(half_done.out, wait_s=0.1):
        pass
    assert len(half_done.run()) == 6
