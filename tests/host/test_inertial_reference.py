"""Each kernel of the inertial core against a dense reference in NumPy, in a process without the compiler."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent


def test_each_kernel_agrees_with_the_dense_reference():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(HERE.parents[1] / "host")}
    program = [sys.executable, str(HERE / "inertial_reference.py")]
    done = subprocess.run(program, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) == 15
