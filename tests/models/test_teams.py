"""The processes of a team end with the process that started them, and pass errors on to it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hoidata.errors import BadInput
from models.common.team import Team, run_team

PARENT = """
import signal, sys
from pathlib import Path
from models.common.team import run_team
from tests.models.test_teams import note_and_wait
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a script that starts it with `&`; inherited
run_team(note_and_wait, 2, Path(sys.argv[1]) / "meeting", Path(sys.argv[1]))
"""


def note_and_wait(folder: Path) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    (folder / f"pid-{Team.joined().rank}").write_text(str(os.getpid()))
    time.sleep(120)


def refuse() -> None:
    raise BadInput("training of length", "finite losses and weights", f"nan by {Team.joined().size}", "lower it")


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[1][0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.long
def test_no_process_of_a_team_outlives_its_parent(tmp_path: Path) -> None:
    command, root = [sys.executable, "-c", PARENT, str(tmp_path)], Path(__file__).parents[2]
    parent = subprocess.Popen(command, cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    notes = [tmp_path / f"pid-{rank}" for rank in range(2)]
    until = time.monotonic() + 60
    while not all(note.is_file() and note.read_text() for note in notes) and time.monotonic() < until:
        time.sleep(0.05)
    pids = [int(note.read_text()) for note in notes]
    parent.kill()
    parent.wait()
    until = time.monotonic() + 10
    while any(map(is_alive, pids)) and time.monotonic() < until:
        time.sleep(0.05)
    left = [pid for pid in pids if is_alive(pid)]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert left == []


@pytest.mark.slow
def test_an_error_in_a_team_is_raised_unchanged(tmp_path: Path) -> None:
    with pytest.raises(BadInput) as raised:
        run_team(refuse, 2, tmp_path / "meeting")
    assert str(raised.value) == "training of length: expected finite losses and weights, got nan by 2; lower it"
