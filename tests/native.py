"""What tests of native FMUs share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cosim.fmi.native.compiler import compiler

NEEDS_COMPILER = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def is_subnormal(a: Any) -> Any:
    """Return True for subnormal values, neither zero nor normal numbers."""
    return (a != 0.0) & (np.abs(a) < np.finfo(float).tiny)
