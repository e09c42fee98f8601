"""How far a hidden effect of the FMUs' suite is from the best replacement of it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.blind import fmu_apart
from tests.blind.field_rig import Entry
from tests.blind.field_visibility import middling
from tests.blind.fmu_study import draw
from tests.blind.fmu_truths import RIGS


@pytest.mark.parametrize(("plant", "way"), sorted(RIGS))
def test_sizes_of_replacements_turn_back_into_parameters(plant: str, way: str) -> None:
    rig = fmu_apart.with_every_kind(plant, way)
    assert set(RIGS[plant, way].entries) <= set(rig.entries)
    for name, entry in rig.entries.items():
        for share in (0.2, 1.0):
            values = middling(rig, name, share)[0]
            sizes = fmu_apart._sizes(entry, values)
            assert fmu_apart._values(entry, sizes) == pytest.approx(values)


def test_a_replacement_adapts_and_keeps_its_side_and_its_shape() -> None:
    entry = Entry(("time",), 1.0, (0.1, 10.0), shape={"damping": (0.4, 0.8)})
    moved = fmu_apart._moved(entry, {"time": 2.0, "damping": 0.6}, [-100.0, 100.0])
    assert moved == {"time": fmu_apart.SMALLEST * 2.0, "damping": 0.8}
    rows = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    assert fmu_apart._adapted(rows @ [2.0, -3.0], rows, 0) == pytest.approx([-2.0, 3.0])


@pytest.mark.thorough
def test_a_lag_below_the_time_between_rows_is_not_told_from_one_of_second_order() -> None:
    ((other, nats),) = fmu_apart.nearest(draw(7094)).values()
    assert other == "second_order_lag_at_pump_left"
    assert nats < fmu_apart.APART
