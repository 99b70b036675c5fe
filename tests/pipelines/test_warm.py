"""The warm process runs a stage like a new process does, with the same bits on all processors."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hoidata import processor
from hoidata.processor import portable_kernels, processor_name
from pipelines.warm import KILLED, SOCKET, WarmProcess, run_warm
from tests.hoidata.test_lifetime import until

ACT = """
import os, signal, sys, time
from pathlib import Path
what = sys.argv[1]
print(what, os.getcwd(), os.environ["WORD"], "HOIDATA_WARM" in os.environ, __name__, flush=True)
print("said", file=sys.stderr)
if what == "wait":
    def stop(*_):
        Path("stopped").touch()
        sys.exit(7)
    signal.signal(signal.SIGTERM, stop)
    Path("began").touch()
    time.sleep(60)
if what == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if what == "raise":
    raise ValueError("words")
sys.exit(3)
"""
SERVE = "from pipelines.warm import serve; serve({!r}, ())"
ASK = "import sys; from pipelines.warm import run_warm; sys.exit(run_warm('act', sys.argv[1:]))"


@pytest.fixture
def warm(tmp_path: Path):
    """A folder with the module ``act``, and the environment of a requesting process in it."""
    (tmp_path / "act.py").write_text(ACT)
    path = tmp_path / "socket"
    paths = os.pathsep.join((str(tmp_path), os.getcwd()))
    server = subprocess.Popen(
        [sys.executable, "-c", SERVE.format(str(path))],
        stdin=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": paths},
        start_new_session=True,
    )
    until(path.exists, 20)
    yield {**os.environ, "PYTHONPATH": paths, "WORD": "given", SOCKET: str(path)}
    server.communicate(timeout=10)
    assert server.returncode == 0


def ask(warm: dict[str, str], folder: Path, action: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", ASK, action], cwd=folder, env=warm, start_new_session=True)


@pytest.mark.parametrize(("action", "code"), [("do", 3), ("raise", 1), ("die", KILLED)])
def test_a_stage_has_the_output_and_exit_code_of_a_new_process(warm, tmp_path: Path, action: str, code: int) -> None:
    both = [
        subprocess.run([sys.executable, *call, action], cwd=tmp_path, env=warm, capture_output=True, text=True)
        for call in (("-c", ASK), ("-m", "act"))
    ]
    warm_run, new_run = both
    assert warm_run.stdout == new_run.stdout.replace("True", "False") == f"{action} {tmp_path} given False __main__\n"
    assert warm_run.stderr.splitlines()[0] == "said"
    assert warm_run.stderr.splitlines()[-1] == new_run.stderr.splitlines()[-1]
    assert (warm_run.returncode, new_run.returncode) == (code, -signal.SIGKILL if action == "die" else code)


def test_signals_are_passed_on_to_the_stage(warm, tmp_path: Path) -> None:
    asking = ask(warm, tmp_path, "wait")
    until((tmp_path / "began").exists, 20)
    asking.send_signal(signal.SIGTERM)
    assert asking.wait(20) == 7
    assert (tmp_path / "stopped").exists()


def test_a_stage_ends_with_the_requesting_process(warm, tmp_path: Path) -> None:
    asking = ask(warm, tmp_path, "wait")
    until((tmp_path / "began").exists, 20)
    fork = [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit() and socket_of(entry, warm)]
    assert len(fork) == 1
    asking.kill()
    asking.wait()
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in fork), 20)


def test_a_stage_ends_if_the_requesting_process_is_killed_before_it_read_everything() -> None:
    output_of = """import os, socket
from pipelines import warm
os.setsid()
stage, asking = socket.socketpair()
stage.send(b"an answer that nobody reads")
asking.close()  # so that the stage is told of a reset, not of an end
warm._pass_signals_on(stage)"""
    assert (
        subprocess.run([sys.executable, "-c", output_of], cwd=Path(__file__).parents[2], check=False).returncode
        == -signal.SIGKILL
    )


def socket_of(process: Path, warm: dict[str, str]) -> bool:
    """Whether a process is a fork of the server, by the socket in its command and by its folder."""
    try:
        command = (process / "cmdline").read_text()
        return "serve" in command and warm[SOCKET] in command and (process / "cwd").readlink() != Path.cwd()
    except OSError:
        return False


def test_a_stage_has_one_blas_thread_whatever_the_environment() -> None:
    code = (
        "import os; from pipelines.warm import ENVIRONMENT; os.environ.update(ENVIRONMENT)\n"
        "import numpy, scipy.linalg; from threadpoolctl import threadpool_info\n"
        "print([pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas'])"
    )
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert set(json.loads(done.stdout)) == {1}


def test_without_a_warm_process_a_stage_runs_in_a_new_process(monkeypatch, tmp_path: Path) -> None:
    assert run_warm("act", []) is None
    monkeypatch.setenv(SOCKET, str(tmp_path / "none"))
    assert run_warm("act", []) is None


needs_avx2 = pytest.mark.skipif(not portable_kernels(), reason="this processor has no AVX2")
# A BLAS sum and a NumPy function, which both have different kernels per processor generation.
COMPUTE = """
import hashlib, numpy
rows = numpy.random.default_rng(0).normal(size=(300, 300))
print(hashlib.sha256((rows @ rows).tobytes()).hexdigest(), hashlib.sha256(numpy.cos(rows).tobytes()).hexdigest())
"""
DOORS = {
    "stage": "import os; from pipelines.warm import ENVIRONMENT; os.environ.update(ENVIRONMENT)\n" + COMPUTE,
    "command": f"""
import pipelines.cli
from hoidata.__main__ import main
pipelines.cli.main = lambda: exec({COMPUTE!r})
main()""",
}
# Kernels of older and newer processors, with the names that OpenBLAS and NumPy use.
PROCESSORS = (
    {"OPENBLAS_CORETYPE": "Sandybridge", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"},
    {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"},
    {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": ""},
)


def output_of(code: str, environment: dict[str, str]) -> str:
    variables = {**os.environ, **environment}
    call = [sys.executable, "-c", code]
    return subprocess.run(call, env=variables, capture_output=True, text=True, check=True, timeout=120).stdout


@needs_avx2
def test_without_the_setting_the_bits_depend_on_the_processor() -> None:
    assert len({output_of(COMPUTE, environment) for environment in PROCESSORS}) > 1


@needs_avx2
@pytest.mark.parametrize("door", DOORS)
def test_a_stage_and_the_command_use_the_same_kernels(door: str) -> None:
    assert len({output_of(DOORS[door], environment) for environment in PROCESSORS}) == 1


@needs_avx2
def test_a_warm_stage_and_its_workers_use_the_same_kernels(monkeypatch, tmp_path: Path) -> None:
    act = f"import subprocess, sys\nexec({COMPUTE!r})\nsys.stdout.flush()\n"
    (tmp_path / "act.py").write_text(f"{act}subprocess.run([sys.executable, '-c', {COMPUTE!r}])")
    for key, value in PROCESSORS[1].items():
        monkeypatch.setenv(key, value)
    warm = WarmProcess()
    warm.start()
    try:
        environment = {**warm.environment, "PYTHONPATH": os.pathsep.join((str(tmp_path), os.getcwd()))}
        ask = "import sys, time; from pathlib import Path; from pipelines.warm import run_warm\n"
        ask += f"while not Path({environment[SOCKET]!r}).exists(): time.sleep(0.02)\nsys.exit(run_warm('act', []))"
        lines = output_of(ask, environment).splitlines()
    finally:
        warm.close()
    assert lines == [output_of(DOORS["stage"], {}).strip()] * 2


# Raw files and clips of a small corpus; MKL is the matrix library of torch.
CORPUS = """
import hashlib, sys
from pathlib import Path
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import get_adapter
from hoidata.hands import load_embedded_hands
from hoidata.synthetic.corpus import write_corpus
folder = Path(sys.argv[1])
write_corpus("h2o", folder / "raw", seed=0, size="small", jobs=1)
convert_dataset(get_adapter("h2o"), folder / "raw", load_embedded_hands(), folder / "clips", progress=False)
for path in sorted(path for path in folder.rglob("*") if path.is_file()):
    print(path.relative_to(folder), hashlib.sha256(path.read_bytes()).hexdigest())
"""


@needs_avx2
@pytest.mark.long
def test_data_do_not_depend_on_the_matrix_kernels_of_torch(tmp_path: Path) -> None:
    outputs = []
    for kernels in ("AUTO", "COMPATIBLE"):
        variables = {**os.environ, **portable_kernels(), "MKL_CBWR": kernels}
        call = [sys.executable, "-c", CORPUS, str(tmp_path / kernels)]
        done = subprocess.run(call, env=variables, capture_output=True, text=True, check=True)
        outputs.append([line for line in done.stdout.splitlines() if line.startswith(("raw/", "clips/"))])
    assert outputs[0]
    assert outputs[0] == outputs[1]


def test_kernels_are_not_set_without_avx2_or_on_another_system(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text("processor: 0\nflags\t\t: fpu sse sse4_2 avx\n")
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "cpuinfo")
    assert portable_kernels() == {}
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "none")
    assert portable_kernels() == {}


def test_the_processor_name_is_that_of_the_system(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text("processor: 0\nmodel name\t: A: fast one\n\nmodel name\t: another\n")
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "cpuinfo")
    assert processor_name() == "A: fast one"
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "none")
    assert processor_name()
