"""What a stage, its workers and the command compute has the same bits, whatever kernels the processor would get."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hoidata import processor
from hoidata.processor import processor_name, same_kernels
from pipelines.warm import SOCKET, WarmProcess

needs_avx2 = pytest.mark.skipif(not same_kernels(), reason="this processor has no AVX2")
# Sums of BLAS and a function of NumPy's own, both of which have one code per generation of processors.
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
# As older and newer processors would have it; the names are OpenBLAS's and NumPy's own.
PROCESSORS = (
    {"OPENBLAS_CORETYPE": "Sandybridge", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"},
    {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"},
    {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": ""},
)


def said(code: str, environment: dict[str, str]) -> str:
    told = {**os.environ, **environment}
    call = [sys.executable, "-c", code]
    return subprocess.run(call, env=told, capture_output=True, text=True, check=True, timeout=120).stdout


@needs_avx2
def test_without_it_the_bits_depend_on_the_processor() -> None:
    assert len({said(COMPUTE, environment) for environment in PROCESSORS}) > 1


@needs_avx2
@pytest.mark.parametrize("door", DOORS)
def test_a_stage_and_the_command_have_one_arithmetic(door: str) -> None:
    assert len({said(DOORS[door], environment) for environment in PROCESSORS}) == 1


@needs_avx2
def test_a_warm_stage_and_its_workers_have_the_same(monkeypatch, tmp_path: Path) -> None:
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
        lines = said(ask, environment).splitlines()
    finally:
        warm.close()
    assert lines == [said(DOORS["stage"], {}).strip()] * 2


def test_a_processor_without_avx2_and_another_system_are_left_alone(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text("processor: 0\nflags\t\t: fpu sse sse4_2 avx\n")
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "cpuinfo")
    assert same_kernels() == {}
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "none")
    assert same_kernels() == {}


def test_the_processor_is_named_as_the_system_names_it(monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "cpuinfo").write_text("processor: 0\nmodel name\t: A: fast one\n\nmodel name\t: another\n")
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "cpuinfo")
    assert processor_name() == "A: fast one"
    monkeypatch.setattr(processor, "_CPUINFO", tmp_path / "none")
    assert processor_name()
