"""Benchmarks of foreign binaries as ratios of CPU time: the filter over a library, an FMU that holds another one."""

from __future__ import annotations

import ctypes
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import median_ratio, running
from cosim.estimation.kernel.generate import generate
from cosim.estimation.kernel.kernel import Filtered
from cosim.estimation.kernel.library_kernel import LibraryKernel, LibraryOf
from cosim.estimation.posing import build_problem
from cosim.estimation.problem import Problem
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.fmi.building.build import build_native
from cosim.fmi.description import read_description
from cosim.fmi.native.compiler import compiler, load_library
from cosim.fmi.wrapping.wrap import wrap
from cosim.logs.log import Log
from cosim.model import Equations, Model, Namespace, Quantity, Values, parameter
from cosim.model.model import Number
from cosim.model.quantities import Parameter
from cosim.probing.places import probe_structure
from cosim.terms.code import FmuModel, TermCode, fmu_model

STEP, ROWS, CALLS = 0.01, 2000, 20_000
EQUAL = 1e-3  # largest difference of the innovations of both kernels, relative to the noise
SUBSTEPS = 2  # of the filter between rows, for both kernels
NOISE = {"current": 1e-2, "motor_angle": 1e-3, "load_angle": 1e-3}
DRIVER = Path(__file__).with_name("bench_library.c")
FIGURES = ("foreign_filter_over_generated", "wrapper_over_original", "wrapper_over_original_derivatives")
BIAS = """static void shape_all(double t, const double *u, const double *m, const double *p, double *out)
{
    out[0] = u[0] + p[0];
}
"""


@dataclass(frozen=True, kw_only=True)
class Drive(Model):
    """A motor with current, shaft and load: five states."""

    base_states = (
        Quantity("current", "A", ""),
        Quantity("motor_angle", "rad", ""),
        Quantity("motor_speed", "rad/s", ""),
        Quantity("load_angle", "rad", ""),
        Quantity("load_speed", "rad/s", ""),
    )
    inputs = (Quantity("voltage", "V", ""),)
    outputs = (base_states[0], base_states[1], base_states[3])
    forced = ("current", "motor_speed", "load_speed")
    rate = STEP
    substep = STEP / SUBSTEPS

    resistance: float = parameter(1.2, unit="ohm", doc="")
    inductance: float = parameter(0.05, unit="H", doc="")
    constant: float = parameter(0.4, unit="N.m/A", doc="")
    inertia: float = parameter(0.01, unit="kg.m2", doc="")
    stiffness: float = parameter(40.0, unit="N.m/rad", doc="")

    def equations(self, m: Namespace) -> Equations:
        """Return the equations of motor, shaft and load."""

        def derivative(t: Number, state: Values, command: Values) -> Values:
            i, a, w, b, v = state
            shaft = self.stiffness * (a - b) + 0.05 * (w - v)
            rate = (command[0] - self.resistance * i - self.constant * w) / self.inductance
            return rate, w, (self.constant * i - shaft - 0.02 * w) / self.inertia, v, (shaft - 0.1 * m.sin(b)) / 0.03

        return Equations(derivative, lambda t, state, command: (state[0], state[1], state[3]))


def library_figures(place: Path) -> dict[str, float | str]:
    """Return each ratio by name, or the reason for a missing one."""
    if compiler() is None:
        return dict.fromkeys(FIGURES, "no C compiler")
    (built,) = build_native(place, f"{Path(__file__).resolve()}:Drive")
    wrapped = place / "wrapped.fmu"
    bias = Parameter("bias_at_voltage.value", 0.0, "V", "offset", neutral=0.0)
    term = TermCode(source=BIAS, parameters=(bias,), inputs=("voltage",), hooks=("shape_all",))
    wrap(built.path, term, {"bias_at_voltage.value": 0.1}, wrapped, substep=STEP)
    figures = {"foreign_filter_over_generated": foreign_filter_over_generated(built.path)}
    for name, way in (("wrapper_over_original", "CoSimulation"), (FIGURES[2], "ModelExchange")):
        with running(built.path, way) as original, running(wrapped, way) as other:
            figures[name] = median_ratio(partial(seconds_of, way, other), partial(seconds_of, way, original))
    return dict(figures)


# -- filter -----------------------------------------------------------------------------------------


def foreign_filter_over_generated(fmu: Path) -> float:
    """Return the time of a filter pass over a binary, relative to the generated C of the same equations."""
    subject = ModelSubject.of(Drive())
    log = noisy_log(subject)
    structure = probe_structure(fmu, [log], way="model-exchange")
    foreign = FmuSubject.of_fmu(structure, [log])
    problem = build_problem(subject, [log], noise=NOISE)
    library = bare_kernel(foreign, fmu)
    innovations = [filtered(k, problem).errors for k in (library, problem.kernel)]
    worst = np.abs((innovations[0] - innovations[1]) / [NOISE[n] for n in problem.layout.outputs]).max()
    assert worst < EQUAL, worst
    return median_ratio(partial(pass_seconds, library, problem), partial(pass_seconds, problem.kernel, problem))


def bare_kernel(foreign: FmuSubject, fmu: Path) -> LibraryKernel:
    """Return the kernel of the library in this process, without terms, which the generated kernel lacks too."""
    model, structure = foreign.model, foreign.structure
    assert isinstance(model, FmuModel)
    names = ("dependencies", "rates", "variables", "forced", "substep", "integrator")
    attributes = {name: getattr(type(model), name) for name in names}
    bare = fmu_model(model.title, (model.base_states, model.inputs, model.outputs), (), (), **attributes)
    sizes = [structure.scales.get(q.name, 0.0) for q in structure.states]
    library = LibraryOf(fmu, read_description(fmu), {}, sizes)
    return LibraryKernel(generate(bare, [q.name for q in bare.outputs]), library)


def noisy_log(subject: ModelSubject) -> Log:
    """Return a simulated log with noise."""
    rng = np.random.default_rng(1)
    time_ = STEP * np.arange(ROWS, dtype=np.float64)
    voltage = np.repeat(rng.uniform(-6.0, 6.0, ROWS // 50 + 1), 50)[:ROWS]
    units = {q.name: q.unit for q in (*subject.inputs, *subject.outputs)}
    empty = {name: np.zeros(ROWS) for name in NOISE}
    log = Log(Path("bench.csv"), time_, {"voltage": voltage}, empty, units, STEP, units, {})
    problem = build_problem(subject, [log], noise=NOISE)
    numbers = problem.numbers(problem.values)
    run = problem.kernel.simulate(
        problem.logs[0], numbers, np.zeros(len(problem.layout.states)), np.zeros(problem.layout.memory)
    )
    noisy = {n: run.outputs[:, k] + NOISE[n] * rng.standard_normal(ROWS) for k, n in enumerate(problem.layout.outputs)}
    return Log(Path("bench.csv"), time_, {"voltage": voltage}, noisy, units, STEP, units, {})


def pass_seconds(kernel: Any, problem: Problem) -> float:
    """Return the CPU time of one filter pass."""
    begin = time.thread_time()
    filtered(kernel, problem)
    return time.thread_time() - begin


def filtered(kernel: Any, problem: Problem) -> Filtered:
    """Return a filter pass over the log of a problem."""
    layout = kernel.layout
    p = np.array([problem.values.get(n, 1.0) for n in layout.parameters])
    data = problem.logs[0]
    count = len(layout.stochastic)
    q, r = np.full(count, 1e-3), np.array([NOISE[n] ** 2 for n in layout.outputs])
    result: Filtered = kernel.run(data, p, np.zeros(len(layout.states)), 1e-4 * np.eye(count), q, r)
    return result


# -- wrapper ----------------------------------------------------------------------------------------


def seconds_of(way: str, fmu: Any) -> float:
    """Return the CPU time of steps, or of derivatives, of an instance."""
    library = load_library(DRIVER.read_text(encoding="utf-8"))
    instance, function = ctypes.c_void_p(fmu.component), partial(pointer_to, fmu)
    references = (ctypes.c_uint * 2)(fmu.references["voltage"], fmu.references["load_angle"])
    begin = time.thread_time()
    if way == "CoSimulation":
        calls = function("SetReal"), function("GetReal"), function("DoStep")
        library.steps(instance, *calls, references, ctypes.c_long(CALLS), ctypes.c_double(STEP))
    else:
        states = (ctypes.c_double * 64)()
        of_states = function("SetContinuousStates"), function("GetDerivatives")
        library.rates(instance, *of_states, ctypes.c_long(10 * CALLS), states, ctypes.c_size_t(fmu.order))
    return time.thread_time() - begin


def pointer_to(fmu: Any, name: str) -> ctypes.c_void_p:
    """Return the address of a function of the library."""
    return ctypes.cast(getattr(fmu.dll, f"fmi2{name}"), ctypes.c_void_p)
