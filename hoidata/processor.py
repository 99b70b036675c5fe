"""Processor name, and environment variables that give equal NumPy and OpenBLAS results on x86-64 with AVX2.

NumPy and OpenBLAS choose kernels by processor, and the kernels differ in the last bits. The variables select the
fastest kernels that all AVX2 processors have. They are read when the libraries are loaded, so they must be set before.
Torch still chooses by processor, so bits of networks depend on it. Bits of data do not: where torch computes hands for
them, NumPy multiplies the matrices (``hoidata.hands.kinematics``).
"""

import platform
from pathlib import Path

_PORTABLE_KERNELS = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}
_CPUINFO = Path("/proc/cpuinfo")


def portable_kernels() -> dict[str, str]:
    """Environment variables for equal kernels; empty without AVX2 or if the processor is unknown."""
    has_avx2 = platform.machine() == "x86_64" and "avx2" in _cpuinfo("flags").split()
    return dict(_PORTABLE_KERNELS) if has_avx2 else {}


def processor_name() -> str:
    """The processor's name as reported by the system."""
    return _cpuinfo("model name") or platform.processor() or platform.machine()


def _cpuinfo(key: str) -> str:
    """Value of a key of /proc/cpuinfo for the first core; empty without one."""
    try:
        lines = _CPUINFO.read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")
