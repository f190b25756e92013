"""The one place that talks to Numba's decorator: compile lazily, cache on disk, use the NumPy error model.

Numba does not notice edits in a kernel that another kernel imports, so the cache folder is keyed by a hash of all
kernel sources and of the versions that shape the machine code. Where that folder cannot be written, a temporary one
is used and `folders.cache_notice()` says so.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faceanim.ground.folders import user_cache, writable_folder

_PACKAGE = Path(__file__).resolve().parent.parent


def _source_key() -> str:
    import llvmlite
    import numba
    import numpy

    digest = hashlib.sha256()
    for version in (numba.__version__, llvmlite.__version__, numpy.__version__):
        digest.update(version.encode())
    for folder in (_PACKAGE / "kernels", _PACKAGE / "backends", _PACKAGE / "ground"):
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _prepare() -> Any:
    # A busy second core must not stall the first one; read when the threading layer starts.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    import numba

    config: Any = numba.config
    if "NUMBA_CACHE_DIR" not in os.environ:
        config.CACHE_DIR = str(writable_folder(user_cache() / "kernels" / _source_key(), "kernel cache"))
    if "NUMBA_CPU_FEATURES" not in os.environ:
        config.CPU_FEATURES = _wide_features(config.ENABLE_AVX)
    return numba


def _wide_features(wanted: bool) -> str | None:
    """Return the machine's features with 512-bit vectors allowed where it has them, else None (Numba's own choice).

    For some processors the compiler keeps to 256 bits although the force kernels gain from all 512. The features are
    part of the key under which Numba caches machine code, so caches shared by several machines stay apart.
    """
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    if not (wanted and features.get("avx512f")):
        return None
    return f"{features.flatten()},-prefer-256-bit"


_numba = _prepare()
prange = _numba.prange


def kernel(function: Callable[..., Any] | None = None, *, parallel: bool = False, inline: bool = False) -> Any:
    """Compile a kernel on first use: no bounds checks, no division checks, contraction and reassociation allowed.

    `fastmath` leaves out nnan and ninf, so that a kernel can still test for numbers that are not finite.
    """

    def wrap(f: Callable[..., Any]) -> Any:
        options: dict[str, Any] = {
            "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
            "error_model": "numpy",
            "cache": True,
        }
        if parallel:
            options["parallel"] = True
        else:
            options["nogil"] = True
        if inline:
            options["forceinline"] = True
        return _numba.njit(**options)(f)

    return wrap if function is None else wrap(function)
