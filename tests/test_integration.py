"""Integration: the plant against the model written a second time, and the arithmetic of steps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.model import parameters_of
from cosim.model.integrate import Moment, Stepper, rk4, substeps
from plant.effects import CATALOGUE
from plant.hovercraft import Hovercraft
from tests.cases import some
from tests.independent import COLUMNS, HOLD, Array, excitation, flown, simulate

MOVING = {
    "x": 0.3, "y": -0.2, "x_world": 1.0, "y_world": -2.0, "psi": 0.7, "vx": 0.4, "vy": -0.3, "psi_dot": 1.2,
    "phi": 0.05, "phi_dot": -0.3, "thrust_right": 2.0, "thrust_left": 2.5, "tilt_right": 0.15, "tilt_left": -0.1,
}  # fmt: skip


class Fine(Hovercraft):
    """The craft with ten times the substeps: what is left of a difference is then the equations'."""

    substep = 0.0005


def differences(a: Mapping[str, Array], b: Mapping[str, Array]) -> dict[str, float]:
    """Largest difference of each output over the run."""
    assert set(a) == set(b) == set(COLUMNS)
    return {name: float(np.max(np.abs(a[name] - b[name]))) for name in COLUMNS}


def test_base_model_agrees_with_the_independent_one_to_1e_6() -> None:
    # five seconds, both tilts and duties moving, the model sheet's own number
    commands = excitation(250, duty=0.1)
    got = differences(flown(Stepper(Hovercraft()), commands), simulate(commands))
    assert max(got.values()) < 1e-6, got


@pytest.mark.parametrize(
    ("craft", "numbers"),
    [
        ({}, {}),
        ({"table_roll_stiffness": 0.0, "table_roll_damping": 0.0}, {"k_t": 0.0, "d_t": 0.0}),
        (
            {"table_roll_stiffness": 0.0, "table_roll_damping": 0.0, "roll_ground_effect": False},
            {"k_t": 0.0, "d_t": 0.0, "own_height": 0.0},
        ),
        (
            {"mass": 1.1, "izz": 0.02, "ixx": 0.015, "arm": 0.2, "propeller_radius": 0.1, "height": 0.12},
            {"m": 1.1, "Izz": 0.02, "Ixx": 0.015, "L": 0.2, "R": 0.1, "z": 0.12},
        ),
        (
            {"thrust_offset": -1900.0, "thrust_slope": 340.0, "ground_effect_exponent": 1.5, "gravity": 9.78},
            {"a": -1900.0, "b": 340.0, "k": 1.5, "g": 9.78},
        ),
        ({"lag": 0.12, "friction": 0.6}, {"tau": 0.12, "c": 0.6}),
    ],
    ids=["thesis", "no support", "eq 5.14", "other body", "other propeller", "other lag"],
)
@pytest.mark.parametrize("start", [{}, MOVING], ids=["rest", "moving"])
def test_every_parameter_means_the_same_in_both(
    craft: dict[str, float], numbers: dict[str, float], start: dict[str, float]
) -> None:
    # One second: without support a gentle excitation keeps both heights above R/2, where Γ has a kink.
    # RK4 at 0.5 ms: the base model's 5e-6 at 5 ms, 10⁴ times less; 1e-8 leaves a factor 20.
    commands = excitation(50, duty=0.05)
    commands[:, 2:] *= 0.5
    hover = {name: (Hovercraft(**craft).start_state()[name]) for name in ("thrust_right", "thrust_left")}
    got = differences(flown(Stepper(Fine(**craft)), commands, start), simulate(commands, {}, numbers, hover | start))
    assert max(got.values()) < 1e-8, got


def test_hard_excitation_costs_accuracy_in_the_roll_rate_only() -> None:
    # Duties over the whole fitted range (6-7 %) and a roll angle to start from. Roll is the fastest mode:
    # two poles near √(k_t/Ixx) = 24 rad/s, so h·λ = 0.12 and RK4 errs by (hλ)⁵/120 = 2e-7 of the moment's
    # φ̈ each substep, some 20 of which add up within the mode's memory. All else stays at the sheet's 1e-6.
    commands = excitation(250)
    assert np.ptp(commands[:, 0]) > 0.4
    got = differences(flown(Stepper(Hovercraft()), commands, MOVING), simulate(commands, start=MOVING))
    assert got.pop("phi_dot") < 1e-5
    assert max(got.values()) < 1e-6, got


def test_a_propeller_at_the_lowest_height_is_integrated_across_the_kink() -> None:
    # φ = 0.3 rad puts the left propeller below R/2, where Γ stays constant. RK4 meets the kink once:
    # one substep of the slope's jump, h²/8 · jump ≈ 1e-4 in the roll rate; a hundred times less at h/10.
    start = {"phi": 0.3}
    commands = excitation(50, duty=0.1)
    exact = simulate(commands, start=start)
    assert max(differences(flown(Stepper(Hovercraft()), commands, start), exact).values()) < 2e-4
    assert max(differences(flown(Stepper(Fine()), commands, start), exact).values()) < 2e-6


def test_error_falls_with_the_fourth_power_of_the_substep() -> None:
    commands = excitation(50)
    exact = simulate(commands, start=MOVING)
    errors = []
    for length in (0.02, 0.01, 0.005):
        craft = type("Craft", (Hovercraft,), {"substep": length})()
        errors.append(max(differences(flown(Stepper(craft), commands, MOVING), exact).values()))
    for coarse, fine in itertools.pairwise(errors):
        assert 12 < coarse / fine < 24  # 2⁴ = 16, and the next order of a step that is not yet tiny


def test_runge_kutta_is_exact_for_a_cubic() -> None:
    # ẋ = 4t³ is a quadrature, for which the method is Simpson's rule: exact up to rounding
    assert rk4(lambda t, x, u: (4 * t**3,), 1.0, (1.0,), (), 0.5) == pytest.approx((1.5**4,), rel=1e-15)


@pytest.mark.parametrize(
    ("step", "count"),
    [
        (0.02, 4),
        (0.0200000003, 4),  # a host's rounding is no reason for a fifth
        (0.0199999997, 4),
        (0.02001, 5),  # but a longer step is
        (0.005, 1),
        (0.0025, 1),
        (1e-9, 1),
        (0.1, 20),
        (1 / 3, 67),
    ],
)
def test_substeps_are_no_longer_than_5_ms(step: float, count: int) -> None:
    assert substeps(step, Hovercraft.substep) == count
    assert step / count <= 0.005 * (1 + 1e-6)


def test_a_host_s_rounding_changes_the_result_by_no_more_than_itself() -> None:
    stepper = Stepper(Hovercraft())
    moment = stepper.start(0.0, MOVING)
    command = (6.5, 6.3, 0.1, -0.05)
    plain, rounded = (stepper.step(moment, command, h).state for h in (0.02, 0.0200000003))
    # 3e-10 s times the largest rate, φ̈ ~ 50 rad/s²
    assert np.max(np.abs(np.subtract(plain, rounded))) < 2e-8


piece = st.tuples(st.floats(5.5, 7.5), st.floats(5.5, 7.5), st.floats(-0.8, 0.8), st.floats(-0.8, 0.8))
property_settings = settings(deadline=None, derandomize=True, max_examples=30)


@pytest.mark.thorough
@property_settings
@given(st.lists(piece, min_size=3, max_size=3), st.floats(-1, 1))
def test_one_step_is_as_good_as_its_halves(pieces: list[tuple[float, ...]], speed: float) -> None:
    start = {"vx": speed, "psi_dot": 2 * speed, "phi": 0.1 * speed}
    commands = np.repeat(np.array(pieces), 5, axis=0)
    whole = flown(Stepper(Hovercraft()), commands, start)
    halves = flown(Stepper(Hovercraft()), np.repeat(commands, 2, axis=0), start, hold=HOLD / 2)
    for name in COLUMNS:
        # the substeps are the same 5 ms; only the rounding of t differs
        assert halves[name][::2] == pytest.approx(whole[name], rel=1e-12, abs=1e-12), name


@property_settings
@given(piece, st.sampled_from([1e-3, 0.004, 0.007, 0.013, 0.05]))
def test_any_communication_step_reaches_the_same_place(command: tuple[float, ...], h: float) -> None:
    # a quarter of a second, its end made up by one odd step; what differs is RK4's own error at 5 ms,
    # 1.4e-6 at the worst corner of the box of commands (tilts ±0.8 rad), twice that allowed
    stepper = Stepper(Hovercraft())
    reference = moment = stepper.start()
    for _ in range(250):
        reference = stepper.step(reference, command, 1e-3)
    for _ in range(int(0.25 / h + 1e-9)):
        moment = stepper.step(moment, command, h)
    if (rest := 0.25 - moment.t) > 1e-12:
        moment = stepper.step(moment, command, rest)
    assert moment.t == pytest.approx(reference.t, abs=1e-12)
    assert np.max(np.abs(np.subtract(moment.state, reference.state))) < 3e-6


def ends_of_bounds() -> Iterator[Any]:
    """Every parameter at both ends of its bounds, an effect's all at once."""
    for p in parameters_of(Hovercraft):
        for value in p.bounds if not isinstance(p.default, bool) else ():
            yield pytest.param({p.name: float(value)}, id=f"{p.name}={value}")
    for kind in CATALOGUE:
        names = [p.name for p in parameters_of(kind)]
        for ends in itertools.product((0, 1), repeat=len(names)):
            values = {p.name: float(p.bounds[end]) for p, end in zip(parameters_of(kind), ends, strict=True)}
            yield pytest.param({f"{kind.name}.{n}": v for n, v in values.items()}, id=f"{kind.name}{ends}")


@pytest.mark.parametrize("values", some(ends_of_bounds(), every=4))
def test_craft_stays_finite_at_the_ends_of_its_bounds(values: dict[str, float]) -> None:
    craft = Hovercraft().with_values(values)
    hover = craft.start_command()
    y = flown(Stepper(craft), [(6.8, 6.2, 0.3, -0.1)] * 50 + [hover] * 50)
    assert all(np.all(np.isfinite(trace)) for trace in y.values())
    assert np.max(np.abs(y["phi"])) < math.pi  # on its table, not tumbling


def test_time_is_what_the_host_says() -> None:
    # autonomous but for the battery: the same state at another time moves alike, bit for bit
    stepper = Stepper(Hovercraft())
    early = stepper.step(stepper.start(0.0, MOVING), (6.5, 6.3, 0.1, 0.0), 0.02)
    late = stepper.step(stepper.start(16.0, MOVING), (6.5, 6.3, 0.1, 0.0), 0.02)
    assert early.state == late.state
    assert (early.t, late.t) == (0.02, 16.0 + 0.02)


def test_a_moment_is_all_there_is() -> None:
    # going back to a moment and on again is bit for bit the same: no state hides in the stepper
    stepper = Stepper(Hovercraft())
    a = stepper.start(0.0, MOVING)
    b = stepper.step(a, (6.5, 6.3, 0.1, 0.0), 0.02)
    stepper.step(b, (7.0, 6.0, -0.5, 0.3), 0.02)
    assert stepper.step(Moment(a.t, a.state, a.memory), (6.5, 6.3, 0.1, 0.0), 0.02) == b
    assert math.isfinite(sum(b.state))
