"""The table of thresholds: it is that of the code, and a change reaches every module that uses one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cosim.refinement.decision import judgement
from cosim.refinement.search import attribution, hypotheses
from tests.blind import thresholds as suite

PAGE = Path(__file__).resolve().parent.parent / "docs" / "thresholds.md"


def test_the_page_of_thresholds_is_that_of_the_code() -> None:
    assert PAGE.read_text(encoding="utf-8") == suite.table(), (
        "python -m tests.blind.thresholds table > docs/thresholds.md"
    )


def test_every_threshold_that_decides_is_in_the_code_and_says_what_it_means() -> None:
    deciding = {(t.module, t.name): t for t in suite.thresholds() if t.decides}
    assert deciding.keys() == {(module, name) for module, names in suite.DECIDING.items() for name in names}
    assert [t.name for t in deciding.values() if not t.meaning] == []


def test_a_threshold_is_changed_wherever_it_is_used_and_put_back() -> None:
    (significant,) = (
        t for t in suite.thresholds() if (t.module, t.name) == ("refinement.decision.judgement", "SIGNIFICANT")
    )
    before = hypotheses.NOISE
    with suite.changed(significant, 2.0):
        assert judgement.SIGNIFICANT == attribution.SIGNIFICANT == 2.0 * significant.value
        assert before == hypotheses.NOISE
    assert judgement.SIGNIFICANT == attribution.SIGNIFICANT == significant.value


def watched(plain: float, **cases: float) -> suite.Watched:
    """A number with values in cases; their factor is 1."""
    return suite.Watched(plain, {(name, 1.0): value for name, value in cases.items()}, set())


@pytest.mark.parametrize("three", [3.0, np.float64(3.0)])
def test_a_comparison_that_comes_out_otherwise_is_noted(three: float) -> None:
    number = watched(4.0, low=2.0, high=8.0)
    assert three < number
    assert number.noted == {("low", 1.0)}
    assert three * number + 2.0 * three > 10.0  # 18, 12 and 30
    assert number.noted == {("low", 1.0)}
    assert 30.0 - number * 2.0 > 20.0  # 22, 26 and 14
    assert number.noted == {("low", 1.0), ("high", 1.0)}


def test_a_comparison_of_arrays_is_noted_where_one_element_comes_out_otherwise() -> None:
    number = watched(4.0, low=2.0, high=8.0)
    assert (np.array([1.0, 3.0]) > number).tolist() == [False, False]
    assert number.noted == {("low", 1.0)}


def test_what_becomes_a_plain_number_is_noted_in_all_cases() -> None:
    number = watched(4.0, low=2.0, high=8.0)
    assert math.log(2.0 * number) == math.log(8.0)
    assert number.noted == {("low", 1.0), ("high", 1.0)}


def test_two_thresholds_in_one_number_are_noted_each() -> None:
    one, other = watched(4.0, one=2.0), watched(3.0, other=9.0)
    other.noted = one.noted
    assert one + other < 8.0
    assert one.noted == {("other", 1.0)}
