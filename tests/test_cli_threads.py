"""Threads of linear algebra in a command: one, because fits run side by side."""

from __future__ import annotations

import subprocess
import sys

RUN = """
import os, sys
os.environ.pop("OPENBLAS_NUM_THREADS", None)
from cosim import __main__ as program
assert "numpy" not in sys.modules
sys.argv = ["cosim", "compare", "a.csv", "b.csv"]
try:
    program.main()
except SystemExit:
    pass
print("threads:", os.environ["OPENBLAS_NUM_THREADS"], "numpy" in sys.modules)
"""


def test_threads_are_limited_before_numpy_is_imported() -> None:
    done = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=False)
    assert "threads: 1 True" in done.stdout, done.stderr
