"""How often Python looks for garbage that counting references does not find."""

from __future__ import annotations

import gc

SELDOM = (
    100_000,
    20,
    100,
)  # objects made between looks: nearly all that is read from large files stays


def collect_seldom() -> tuple[int, int, int]:
    """Look seldom in this process; what was set before, for `gc.set_threshold`."""
    before = gc.get_threshold()
    gc.set_threshold(*SELDOM)
    return before
