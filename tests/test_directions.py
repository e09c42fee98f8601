"""Forces at a coordinate that accelerate others too: their direction is that of a settable damping of the FMU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.blocks.derivatives import DifferentiableFmu
from cosim.core.arrays import Array
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.fmi.description import read_description
from cosim.fmi.wrapping.wrap import wrap
from cosim.logs.log import Log
from cosim.probing.fmu_structure import Structure
from cosim.probing.places import probe_structure
from cosim.terms.code import term_code
from tests.blind.fmu_build import PLANTS, build
from tests.logs import times
from tests.native import NEEDS_COMPILER

pytestmark = NEEDS_COMPILER
NUMBERS = {p.name: p.start for p in PLANTS["pendulum"].parameters}
LEVEL, DRAG, SOFTNESS = 0.04, 0.003, 0.02
FORCES = {"coulomb_at_w.level": LEVEL, "coulomb_at_w.softness": SOFTNESS, "quadratic_drag_at_w.coefficient": DRAG}
POINTS = np.random.default_rng(4).uniform(-1.0, 1.0, (20, 4)) * [1.0, 1.0, 3.0, 4.0]
STEP = 0.02


def rates(x: Any, force: float, hinge: float = NUMBERS["hinge"]) -> Array:
    """Return the derivatives by the mass matrix, with dry friction and drag at the hinge."""
    p, (_, v, phi, w) = NUMBERS, x
    sin, cos, bob, length = np.sin(phi), np.cos(phi), NUMBERS["bob"], NUMBERS["length"]
    mass = [[p["cart"] + bob, bob * length * cos], [bob * length * cos, bob * length**2]]
    push = force - p["spring"] * x[0] - p["rub"] * v + bob * length * sin * w * w
    turn = -bob * 9.81 * length * sin - hinge * w - LEVEL * np.tanh(w / SOFTNESS) - DRAG * w * abs(w)
    dv, dw = np.linalg.solve(mass, [push, turn])
    return np.array([v, dv, w, dw])


def log_of_sines() -> Log:
    time = times(7.98)
    force = 2.0 * np.sin(2.1 * time) + np.sin(5.3 * time)
    return Log(Path("a.csv"), time, {"force": force}, {}, {}, STEP, {}, {})


@pytest.fixture(scope="module", params=[2, pytest.param(3, marks=pytest.mark.thorough)])
def structure(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Structure:
    fmu = build(tmp_path_factory.mktemp("pendulum") / "pendulum.fmu", "pendulum", request.param)
    return probe_structure(fmu, [log_of_sines()])


@pytest.fixture(scope="module")
def wrapped(structure: Structure) -> Path:
    model = FmuSubject.of_fmu(structure, [log_of_sines()]).model
    code = term_code(model, {n.partition(".")[0] for n in FORCES}, [q.name for q in structure.states])
    path = structure.fmu.with_name("wrapped.fmu")
    wrap(structure.fmu, code, FORCES, path)
    return path


@contextmanager
def opened(path: Path, **start: float) -> Iterator[DifferentiableFmu]:
    block = DifferentiableFmu("plant", path, read_description(path), start, frozenset())
    block.bind_nothing()
    block.open(0.0, 1.0)
    block.start()
    try:
        yield block
    finally:
        block.close()


def rates_of(block: DifferentiableFmu, x: Array, force: float) -> Array:
    u = np.array([force])
    return block.rates(block.move(0.5, x, u), u)[:4]


# -- probing ----------------------------------------------------------------------------------------


def test_a_friction_at_a_hinge_tells_how_forces_act_there(structure: Structure) -> None:
    rub, hinge = structure.dampings
    assert (rub.parameter, rub.pair.velocity, rub.port, rub.rates) == ("rub", "v", "force", ("v", "w"))
    assert (hinge.parameter, hinge.pair.velocity, hinge.port, hinge.rates) == ("hinge", "w", "", ("v", "w"))
    assert structure.directions == (hinge,)
    assert (hinge.in_step, hinge.is_constant) == (True, False)


def test_the_delivered_fmu_has_the_forces_saves_its_state_and_equals_the_original_when_they_sleep(
    structure: Structure, wrapped: Path
) -> None:
    still = {"coulomb_at_w.level": 0.0, "quadratic_drag_at_w.coefficient": 0.0}
    with opened(wrapped, **still) as dormant, opened(structure.fmu) as original:
        for x in POINTS:
            assert rates_of(dormant, x, 1.5).tolist() == rates_of(original, x, 1.5).tolist()
    x, other = POINTS[:2]
    with opened(wrapped) as one, opened(wrapped, hinge=0.3) as two:
        first, second = rates_of(one, x, 1.0), rates_of(two, x, 1.0)
        assert first == pytest.approx(rates(x, 1.0), rel=1e-9)
        assert second == pytest.approx(rates(x, 1.0, hinge=0.3), rel=1e-9)
        fmu, its = one.instance.fmu, two.instance.fmu
        state = fmu.getFMUState()
        data = fmu.serializeFMUState(state)
        for serialized in (False, True):
            rates_of(one, other, -2.0)
            fmu.setFMUState(fmu.deserializeFMUState(data) if serialized else state)
            assert one.current_point()[0].tolist() == x.tolist()
            assert one.rates(x, np.array([1.0]))[:4].tolist() == first.tolist()
        assert rates_of(two, x, 1.0).tolist() == second.tolist()
        fmu.freeFMUState(state)
        its.setFMUState(its.deserializeFMUState(data))  # with the friction of the first
        assert rates_of(two, x, 1.0).tolist() == first.tolist()
