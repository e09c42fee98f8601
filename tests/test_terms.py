"""Terms of the general catalogue: binding to places, lags against exact solutions, printed C, terms of a user."""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lsim

from cosim.base.errors import InputError
from cosim.fmi.native.compiler import load_library
from cosim.loading.file import own_terms
from cosim.model.namespaces import SCALAR
from cosim.model.quantities import Parameter, Quantity, parameters_of
from cosim.terms.catalogue import (
    Cogging,
    Coulomb,
    InputLag,
    Overflow,
    Play,
    RateLimit,
    Saturation,
    SecondOrderLag,
    Stribeck,
    bound_terms,
    sensor_errors,
)
from cosim.terms.fmu_model import Dependencies, FmuModel, fmu_model
from cosim.terms.language import Force, Place, bind, unit_of, with_place
from cosim.terms.term_printing import term_code

INPUT = Place("voltage", {"u": "V", "T": "s"}, {"u": 4.0, "T": 0.1}, input=0)
PAIR = Place(
    "speed", {"u": "V", "v": "rad/s", "q": "rad", "d": "rad"}, {"u": 4.0, "v": 10.0, "q": 3.0, "d": 9.0}, 0, 0, 1
)
STORE = Place("level", {"q": "m", "r": "m/s"}, {"q": 0.1, "r": 0.02}, state=0, middle=0.5)


def test_a_bound_term_has_the_name_units_and_sizes_of_its_place() -> None:
    coulomb = bind(Coulomb, PAIR)
    level, softness = parameters_of(coulomb)
    assert coulomb.name == "coulomb_at_speed"
    assert (level.unit, level.typical, level.bounds, level.neutral) == ("V", pytest.approx(0.4), (0.0, 20.0), 0.0)
    assert (softness.unit, softness.default, softness.neutral) == ("rad/s", pytest.approx(0.2), None)
    assert coulomb().dormant
    assert not coulomb(level=1.0).dormant
    assert bind(Cogging, PAIR).starts[0]["period"] == pytest.approx(3.0)


def test_a_level_counts_from_the_mean_of_its_state() -> None:
    (coefficient, level) = parameters_of(bind(Overflow, STORE))
    assert (coefficient.unit, level.unit) == ("1/s", "m")
    assert (level.default, level.bounds) == (pytest.approx(0.6), pytest.approx((0.1, 0.9)))


@pytest.mark.parametrize(
    ("expression", "unit"),
    [("u", "V"), ("u/v", "V.s/rad"), ("u/v^2", "V.s2/rad2"), ("s/u", "s/V"), ("1", ""), ("u/x", "")],
)
def test_units_are_products_of_those_of_the_place(expression: str, unit: str) -> None:
    assert unit_of(expression, {"u": "V", "v": "rad/s", "x": "furlongs"}) == unit


def test_every_term_finds_its_places_and_no_other() -> None:
    names = {term.name for term in bound_terms([INPUT, PAIR, STORE])}
    assert {"dead_band_at_voltage", "lag_at_voltage", "stribeck_at_speed", "leak_at_level"} <= names
    assert "offset_at_speed" not in names  # the port's bias is the same
    assert not {n for n in names if n.startswith(("coulomb", "leak")) and n.endswith("voltage")}


@pytest.mark.parametrize("step", [0.01, 0.05])
def test_a_first_order_lag_is_exact_for_held_inputs(step: float) -> None:
    term, memory = bind(InputLag, INPUT)(time=0.3), (0.0, 0.0)
    commands = [1.0, 1.0, 3.0, 3.0, -2.0, -2.0, -2.0]
    value = commands[0]
    for command in commands:
        before = value
        value = command + (value - command) * math.exp(-step / 0.3)
        (mean,), memory = term.shape(SCALAR, 0.0, step, (command,), memory)
        assert memory[0] == pytest.approx(value, rel=1e-12)
        exact = command + (before - command) * (1.0 - math.exp(-step / 0.3)) * 0.3 / step
        assert mean == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("damping", [0.05, 0.4, 2.5])
def test_a_lag_of_second_order_is_exact_for_steps_of_any_length(damping: float) -> None:
    time, step, count = 0.2, 0.5, 20
    term, memory = bind(SecondOrderLag, INPUT)(time=time, damping=damping), (0.0, 0.0, 0.0)
    (_,), memory = term.shape(SCALAR, 0.0, step, (0.0,), memory)
    ends, means = [], []
    for _ in range(count):
        (mean,), memory = term.shape(SCALAR, 0.0, step, (1.0,), memory)
        means.append(mean)
        ends.append(memory[0])
    fine = np.linspace(0.0, count * step, 200 * count + 1)
    _, exact, _ = lsim(([1.0], [time**2, 2.0 * damping * time, 1.0]), np.ones(fine.size), fine)
    assert np.abs(ends - exact[200::200]).max() < 1e-9
    assert np.abs(means - 0.5 * (exact[1:] + exact[:-1]).reshape(count, 200).mean(axis=1)).max() < 1e-4


def test_play_and_rate_limit_begin_at_the_first_input() -> None:
    play, limit = bind(Play, INPUT)(width=0.5), bind(RateLimit, INPUT)(inverse_rate=0.5)
    (value,), memory = play.shape(SCALAR, 0.0, 0.1, (2.0,), (0.0, 0.0))
    assert value == 2.0
    (value,), memory = play.shape(SCALAR, 0.1, 0.1, (2.4,), memory)
    assert value == 2.0
    (value,), _ = play.shape(SCALAR, 0.2, 0.1, (3.0,), memory)
    assert value == pytest.approx(2.5)
    (value,), memory = limit.shape(SCALAR, 0.0, 0.1, (2.0,), (0.0, 0.0))
    (value,), memory = limit.shape(SCALAR, 0.1, 0.1, (5.0,), memory)
    assert (value, memory[0]) == (pytest.approx(2.1), pytest.approx(2.2))  # mean and end at two per second


def test_a_limit_of_the_rate_is_tried_at_one_row_for_a_usual_change() -> None:
    (inverse,) = parameters_of(bind(RateLimit, INPUT))
    assert (inverse.unit, inverse.typical) == ("s/V", pytest.approx(INPUT.sizes["T"] / INPUT.sizes["u"]))


def test_a_peak_of_friction_is_at_least_three_resolved_transitions_wide() -> None:
    limits = {p.name: p.bounds[0] for p in parameters_of(bind(Stribeck, replace(PAIR, resolution=0.5)))}
    assert (limits["softness"], limits["speed"]) == (0.5, 1.5)


def test_friction_that_is_larger_at_rest_falls_to_its_level() -> None:
    term = bind(Stribeck, PAIR)(level=1.0, breakaway=2.0, speed=0.5, softness=0.02)
    assert -term.force(SCALAR, 0.0, 0.1) == pytest.approx(1.0 + math.exp(-0.04), rel=1e-3)
    assert -term.force(SCALAR, 0.0, 10.0) == pytest.approx(1.0)


def test_the_sensors_of_an_output_have_errors_of_its_unit() -> None:
    errors = {
        kind.name: parameters_of(kind)[0] for kind in sensor_errors(Quantity("speed", "rad/s", ""), 10.0, 0.01, 20.0)
    }
    assert {n: p.unit for n, p in errors.items()} == {
        "bias_at_speed": "rad/s",
        "scale_at_speed": "1",
        "drift_at_speed": "rad/s/s",
        "latency_at_speed": "s",
        "lag_at_speed": "s",
    }


def _model() -> FmuModel:
    """A motor behind a library: speed' = f(speed, voltage), angle' = speed."""
    signals = (
        [Quantity("angle", "rad", ""), Quantity("speed", "rad/s", "")],
        [Quantity("voltage", "V", "")],
        [Quantity("angle", "rad", "")],
    )
    depends = Dependencies(np.array([[0, 1], [0, 1], [1, 0]], bool), np.array([[0], [1], [0]], bool))
    model = fmu_model(
        "motor",
        signals,
        [Parameter("inertia", 0.1, "kg.m2", "")],
        list(bound_terms([INPUT, PAIR])),
        dependencies=depends,
        rates={0: 1},
        variables={n: n for n in ("angle", "speed", "voltage", "inertia")},
    )
    assert isinstance(model, FmuModel)
    return model


def test_printed_terms_compute_what_the_terms_state() -> None:
    model = _model()
    code = term_code(model, ["coulomb_at_speed", "dead_band_at_voltage"], ["angle", "speed"])
    assert code.hooks == ("port_inputs",)
    names = [p.name for p in code.parameters]
    assert set(names) == {"dead_band_at_voltage.width", "coulomb_at_speed.level", "coulomb_at_speed.softness"}
    export = (
        "void call(const double *x, const double *u, const double *p, double *out) { port_inputs(0.0, x, u, p, out); }"
    )
    library = load_library(f"#include <math.h>\n{code.source}\n{export}")
    values = {"dead_band_at_voltage.width": 0.5, "coulomb_at_speed.level": 0.3, "coulomb_at_speed.softness": 0.1}
    p, x, u, out = (np.array(a, float) for a in ([*(values[n] for n in names), 0.01], [0.0, -2.0], [2.0], [0.0]))
    library.call(*(a.ctypes.data_as(ctypes.c_void_p) for a in (x, u, p, out)))
    assert out[0] == pytest.approx(1.5 + 0.3 * math.tanh(20.0))
    dormant = np.array([*(p.neutral if p.neutral is not None else p.default for p in code.parameters), 0.01], float)
    library.call(*(a.ctypes.data_as(ctypes.c_void_p) for a in (x, u, dormant, out)))
    assert out[0] == 2.0


def test_the_equations_of_a_library_are_for_symbols_only() -> None:
    with pytest.raises(TypeError, match="library"):
        _model().equations(SCALAR)


def test_a_users_file_adds_terms(tmp_path: Path) -> None:
    file = tmp_path / "my_terms.py"
    file.write_text(
        "from cosim.terms import Force, scaled\n\n"
        "class Windage(Force):\n"
        '    kind = "windage"\n    equation = "-c*v^3"\n'
        '    coefficient: float = scaled("u/v^3", neutral=0.0, typical=0.1, low=0.0, doc="coefficient")\n\n'
        "    def force(self, m, position, velocity):\n        return -self.coefficient * velocity**3\n"
    )
    (windage,) = own_terms(file)
    assert issubclass(windage, Force)
    (bound,) = [t for t in bound_terms([INPUT, PAIR], [windage]) if t.name.startswith("windage")]
    assert (bound.name, bound(coefficient=2.0).force(SCALAR, 0.0, 3.0)) == ("windage_at_speed", -54.0)


def test_a_file_without_terms_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "none.py"
    file.write_text("LIMIT = 3\n")
    with pytest.raises(InputError, match="holds no term"):
        own_terms(file)


def test_a_saturation_acts_as_soon_as_it_is_below_the_largest_value_of_the_logs() -> None:
    """The score test steps from neutral; a limit far above all values would promise nothing."""
    bound = bind(Saturation, replace(INPUT, units={**INPUT.units, "M": "V"}, sizes={**INPUT.sizes, "M": 5.0}))
    (limit,) = parameters_of(bound)
    assert (limit.default, limit.neutral, limit.bounds[0], limit.unit) == (0.2, 0.2, 0.2, "1/V")
    assert bound().change(SCALAR, -9.0) == -9.0
    assert bound(inverse_limit=1.01 * 0.2).change(SCALAR, 5.0) == pytest.approx(5.0 / 1.01)
    assert bound(inverse_limit=1.01 * 0.2).change(SCALAR, 4.9) == 4.9


def test_names_of_variables_become_parts_of_names() -> None:
    assert with_place("load.w[1]") == "load_w_1_"


def test_a_sensor_that_never_reads_below_zero_may_show_the_magnitude() -> None:
    speed = Quantity("speed", "rad/s", "")
    signed, unsigned = ({e.name: e for e in sensor_errors(speed, 3.0, 0.1, 10.0, signed=s)} for s in (True, False))
    assert unsigned.keys() - signed.keys() == {"magnitude_at_speed"}
    reading = unsigned["magnitude_at_speed"](value=1.0)
    assert [reading.read(SCALAR, 0.0, {"speed": y}) for y in (-2.0, 0.0, 2.0)] == [2.0, 0.0, 2.0]
    assert unsigned["magnitude_at_speed"]().read(SCALAR, 0.0, {"speed": -2.0}) == -2.0
    assert not reading.is_straight()


def test_the_transition_of_friction_is_not_finer_than_the_integration() -> None:
    softness = {p.name: p for p in parameters_of(bind(Coulomb, replace(PAIR, resolution=0.05)))}["softness"]
    assert softness.bounds[0] == 0.05
    assert {p.name: p for p in parameters_of(bind(Coulomb, PAIR))}["softness"].bounds[0] == pytest.approx(1e-3)
