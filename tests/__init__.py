"""Tests. Two workers run them side by side; more threads of linear algebra within each only wait for one another."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when numpy is first imported
