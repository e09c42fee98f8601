"""Wrapped FMUs: the original with added terms, in FMPy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.fmi.description import read_description, ways
from cosim.fmi.wrapping.wrap import CannotWrap, wrap
from tests.native import NEEDS_COMPILER
from tests.wrapped import (
    EXCHANGE,
    STEP,
    STEPS,
    exact,
    fmu_of,
    off,
    push,
    simulated,
    states_of,
    terms_of,
)

pytestmark = NEEDS_COMPILER
EACH = pytest.mark.parametrize(
    ("name", "fmi", "way"),
    [
        ("slider", 2, EXCHANGE),
        ("slider", 3, STEPS),
        *(pytest.param("drive", *both, marks=pytest.mark.thorough) for both in ((2, STEPS), (3, EXCHANGE))),
    ],
)
VERSIONS = pytest.mark.parametrize("fmi", [pytest.param(2, marks=pytest.mark.thorough), 3])


@EACH
def test_dormant_it_equals_the_original_to_the_last_bit(name: str, fmi: int, way: str, tmp_path: Path) -> None:
    original = fmu_of(name, fmi, way, tmp_path)
    terms = terms_of("all", states_of(name))
    if way == STEPS:  # terms of derivatives are for model exchange alone
        terms = replace(terms, hooks=("shape_all", "port_inputs", "readings"))
    wrap(original, terms, {}, tmp_path / "wrapped.fmu", substep=1e-3)
    force = push()
    assert off(simulated(original, way, force), simulated(tmp_path / "wrapped.fmu", way, force)) == 0.0
    awake = simulated(tmp_path / "wrapped.fmu", way, force, {"idle_at_force.level": 1.0})
    # Awake, the functions still change nothing, but steps are divided: by the drive's own accuracy.
    assert off(simulated(original, way, force), awake) < (1e-6 if way == EXCHANGE else 1e-3)


@VERSIONS
def test_dry_friction_at_a_port_is_that_of_the_equations(fmi: int, tmp_path: Path) -> None:
    original, level, force = fmu_of("drive", fmi, EXCHANGE, tmp_path), 12.0, push()
    wrap(
        original,
        terms_of("coulomb", states_of("drive")),
        {"coulomb_at_velocity.level": level},
        tmp_path / "w.fmu",
        substep=1e-3,
    )
    drag = {"quadratic_drag.coefficient": 300.0}  # has a kink, where the speed is 0: an event of the original
    for way, near in ((EXCHANGE, 1e-6), (STEPS, 5e-4)):
        truth = simulated(original, way, force, {"coulomb_friction.level": level, **drag})
        assert np.ptp(truth[:, 1]) > 0.1
        assert off(truth, simulated(original, way, force, drag)) > 0.01
        assert off(truth, simulated(tmp_path / "w.fmu", way, force, drag)) < near


@VERSIONS
def test_an_added_rate_acts_in_model_exchange_alone(fmi: int, tmp_path: Path) -> None:
    original, force = fmu_of("drive", fmi, EXCHANGE, tmp_path), push()
    values = {"viscous_at_velocity.coefficient": 1.5}
    wrap(original, terms_of("rate", states_of("drive")), values, tmp_path / "w.fmu")
    assert ways(read_description(tmp_path / "w.fmu")) == ("model-exchange",)
    truth = simulated(original, EXCHANGE, force, {"viscous": 200.0 + 1.5 * 95.0})
    assert off(truth, simulated(tmp_path / "w.fmu", EXCHANGE, force)) < 1e-6
    with pytest.raises(CannotWrap, match="no model exchange"):
        wrap(fmu_of("slider", fmi, STEPS, tmp_path), terms_of("rate"), {}, tmp_path / "w.fmu")


@EACH
def test_what_acts_at_an_input_is_another_input_and_an_offset_of_a_sensor_is_added(
    name: str, fmi: int, way: str, tmp_path: Path
) -> None:
    original, force = fmu_of(name, fmi, way, tmp_path), push()
    for kind, parameter, value, course, shift in (
        ("bias", "bias_at_force.offset", 3.0, lambda f: f + 3.0, 0.0),
        ("dead_band", "dead_band_at_force.half_width", 20.0, lambda f: np.sign(f) * np.maximum(0, abs(f) - 20.0), 0.0),
        ("sensor", "bias_at_position.offset", 0.25, lambda f: f, 0.25),
    ):
        wrap(original, terms_of(kind), {parameter: value}, tmp_path / f"{kind}.fmu", substep=1e-3)
        expected = simulated(original, way, np.column_stack([force[:, 0], course(force[:, 1])]))
        expected[:, 1] += shift
        assert off(expected, simulated(tmp_path / f"{kind}.fmu", way, force)) < 1e-12


@VERSIONS
def test_a_lag_remembers(fmi: int, tmp_path: Path) -> None:
    original, force, time = fmu_of("drive", fmi, STEPS, tmp_path), push(), 0.08
    wrap(original, terms_of("lag"), {"lag_at_force.time": time}, tmp_path / "w.fmu", substep=STEP)
    rows, level = [], force[0, 1]
    for t in np.arange(0.0, force[-1, 0] - STEP / 2, STEP):
        now = force[min(np.searchsorted(force[:, 0], t + 1e-9, side="right"), len(force) - 1), 1]
        level = now + (level - now) * np.exp(-STEP / time)
        rows += [(t, level), (t + STEP, level)]
    assert off(simulated(original, STEPS, np.array(rows)), simulated(tmp_path / "w.fmu", STEPS, force)) < 1e-9
    # In model exchange the course between steps is exact, whatever the substep.
    found = simulated(tmp_path / "w.fmu", EXCHANGE, force)
    assert off(exact(force, lag=time), found) < 1e-6 * np.ptp(found[:, 1:])


@VERSIONS
def test_a_delay_shifts_the_input(fmi: int, tmp_path: Path) -> None:
    original, force = fmu_of("drive", fmi, STEPS, tmp_path), push()
    for delay in (0.12, 0.125):  # a part of a step acts for that part
        wrap(original, terms_of("delay"), {"delay.time": delay}, tmp_path / "w.fmu", substep=STEP)
        expected = exact(force, delay)
        assert off(expected, simulated(tmp_path / "w.fmu", EXCHANGE, force)) < 1e-6
        assert off(expected, simulated(tmp_path / "w.fmu", STEPS, force)) < (1e-6 if delay == 0.12 else 1e-4)
