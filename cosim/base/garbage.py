"""The interval between runs of Python's garbage collector."""

from __future__ import annotations

import gc

SELDOM = (100_000, 20, 100)  # Collections are rare, because nearly all objects read from large files stay in use.


def collect_seldom() -> tuple[int, int, int]:
    """Make garbage collection rare; return the previous thresholds."""
    thresholds = gc.get_threshold()
    gc.set_threshold(*SELDOM)
    return thresholds
