"""Cases that try one branch of the code with many inputs: `make test` has some of them, `make thorough` the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def some(cases: Iterable[Any], every: int) -> list[Any]:
    """Return all cases; those between the first of `every` and the next are for `make thorough`."""
    return [case if k % every == 0 else _thorough(case) for k, case in enumerate(cases)]


def _thorough(case: Any) -> Any:
    """Return a case for `make thorough`."""
    if isinstance(case, _Case):
        return pytest.param(*case.values, id=case.id, marks=(*case.marks, pytest.mark.thorough))
    return pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.thorough)


_Case = type(pytest.param())
