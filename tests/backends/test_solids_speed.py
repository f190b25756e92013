"""What large bodies may cost: `tools/bench_solids.py` measures it, each part in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "bench_solids.py"


@pytest.mark.slow
@pytest.mark.parametrize(("part", "seconds", "peak_mb"), [("large_solve", 30.0, 2048.0), ("face_modes", 60.0, 2048.0)])
def test_time_and_memory(part: str, seconds: float, peak_mb: float) -> None:
    """20,000 nonlinear elements are solved in 30 s and 2 GB; the modes of the default face take less than a minute."""
    done = subprocess.run([sys.executable, str(TOOL), part], check=True, capture_output=True, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["elements"] > 19_000
    assert found["seconds"] < seconds and found["peak_mb"] < peak_mb
