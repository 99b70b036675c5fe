"""What the processor is, and the same kernels of NumPy and OpenBLAS on every x86-64 processor with AVX2.

Both choose among several by the processor they find, and the choices differ in the last bits: a corpus written on a
processor with AVX-512 was not that of one without. What is set here is the fastest that all of them have. It is read
when the libraries are loaded, so it belongs into the environment before. Torch still chooses by the processor: bits of
networks depend on it, bits of data do not.
"""

import platform
from pathlib import Path

_SAME = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}
_CPUINFO = Path("/proc/cpuinfo")


def same_kernels() -> dict[str, str]:
    """The environment that gives them; empty where this processor has no AVX2, or the system does not say."""
    is_known = platform.machine() == "x86_64" and "avx2" in _told("flags").split()
    return dict(_SAME) if is_known else {}


def processor_name() -> str:
    """As the system gives it."""
    return _told("model name") or platform.processor() or platform.machine()


def _told(key: str) -> str:
    """What the system says of the first core under a key; nothing where it says nothing."""
    try:
        lines = _CPUINFO.read_text().splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")
