"""Numbers that the thesis' own scripts make, and those of docs/seed.md beside them."""

from __future__ import annotations

import pytest

from tests.thesis import ROWS

# thesis, ours; data are drawn with a fixed seed
NUMBERS: dict[str, list[tuple[float, float]]] = {
    # the first is off by corrections of 19, 19, 18, … 1 times, 10.45 times in the mean; the last has the mass of eq 5.2
    "D.3.5": [(-1.17e-4, 8.942e-4), (-1.17e-4, -1.885e-4), (-1.17e-4, -1.17e-4)],
    "D.3.2": [(1.8996, 1.9003), (0.01229, 0.008663)],  # k of one set, and its scatter
    # 10·log10(1 + (10·0.0884)²) dB; atan(0.1·0.0884) = 0.506°
    "D.3.4": [(-2.827, -2.507), (-40.97, -41.48), (0.0899, 0.0884)],
    "D.3.3": [(155.38, 191.37), (1.5, 0.3873)],  # 4.20; 1.5/√15
    "3.3.1": [(1.75, 1.690)],
    "3.3.2": [(6500.0, 1831), (6500.0, 4720)],
    "4.3.1": [(3, 1)],
    "4.3.4": [(0.1099, 0.0884)],
    "6.1": [(0.6375, 0.09686), (0.001858, 0.001872)],  # (K₃²·W₁ + K₄²·W₂ + K₅²·W₃)^½ and what it moves
}


@pytest.mark.parametrize("name", NUMBERS)
def test_the_numbers_of_a_row(name: str) -> None:
    found = [(row.thesis, row.ours) for row in ROWS[name]()]
    assert found == [pytest.approx(pair, rel=5e-4) for pair in NUMBERS[name]]


def test_single_precision_moves_the_estimates_of_app_f_by_micrometres() -> None:
    sigma, position, heading = ROWS["F"]()
    assert sigma.ours == pytest.approx(1.5870, abs=5e-5)
    assert sigma.thesis != sigma.ours
    assert sigma.thesis == pytest.approx(sigma.ours, rel=1e-4)  # 3000 roundings of 6e-8 each
    assert 1e-7 < position.thesis < 1e-4  # [m]; the last bits differ by machine
    assert 0.0 < heading.thesis < 1e-7
