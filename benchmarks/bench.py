"""Benchmarks as median ratios, interleaved in one process because shared machines are noisy."""

from __future__ import annotations

import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from benchmarks.bench_coupling import coupling_figures
from benchmarks.bench_library import library_figures
from benchmarks.bench_native import native_figures
from benchmarks.bench_peers import lags_scenario, peer_figures
from benchmarks.measure import median_ratio, running
from controller.loop import Loop
from controller.settings import Settings
from cosim.blocks.faults import gaussian, stream
from cosim.core.arrays import Array
from cosim.core.errors import Interrupted
from cosim.fmi.fmu_build import build
from cosim.fmi.native.compiler import compiler
from cosim.isolation import worker
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import Rows, allocate, mapped_table
from cosim.isolation.watch import Watch
from cosim.master.master import PROGRESS_EVERY_STEPS, simulate
from cosim.master.observer import Observer
from cosim.model import Stepper
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.workflow import run
from cosim.system.system import System, build_system
from fmus.recipes import controller_recipe, plant_recipe
from plant.hovercraft import SENSOR_VARIANCE, Hovercraft

H = 0.02
STEPS = 1000
MANY = 100_000  # steps of FMUs with next to no computation
NOISE = {name: SENSOR_VARIANCE[name] for name in ("psi", "psi_dot", "ax")}

SCENARIO = """
name: bench
duration: {duration}
step: 0.02
seed: 1
components:
  plant: {{fmu: plant.fmu, start: {{x_start: 1, psi_start: 1}}}}
  controller: {{fmu: controller.fmu, start: {{x_hat_start: 1, psi_hat_start: 1}}}}
  reference: {{block: reference, signals: {{x_ref: {{unit: m}}, psi_ref: {{unit: rad}}}}}}
connections:
  - {{from: plant.psi, to: controller.psi, noise: {{variance: {psi}}}}}
  - {{from: plant.psi_dot, to: controller.psi_dot, noise: {{variance: {psi_dot}}}}}
  - {{from: plant.ax, to: controller.ax, noise: {{variance: {ax}}}}}
  - {{from: reference.x_ref, to: controller.x_ref}}
  - {{from: reference.psi_ref, to: controller.psi_ref}}
  - {{from: controller.duty_right, to: plant.duty_right}}
  - {{from: controller.duty_left, to: plant.duty_left}}
  - {{from: controller.tilt_right, to: plant.tilt_right}}
  - {{from: controller.tilt_left, to: plant.tilt_left}}
"""
IDLE_SLAVE = '''
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class {name}(Fmi2Slave):
    """Does nothing."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for k in range({inputs}):
            setattr(self, f"u{{k}}", 0.0)
            self.register_variable(Real(f"u{{k}}", causality=Fmi2Causality.input))
        for k in range({outputs}):
            setattr(self, f"y{{k}}", 0.0)
            self.register_variable(Real(f"y{{k}}", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        return True
'''


def bench() -> dict[str, float | str]:
    """Return every ratio by name, or the reason for a missing one."""
    with tempfile.TemporaryDirectory(prefix="cosim-bench-") as folder:
        place = Path(folder)
        build(plant_recipe(), place / "plant.fmu")
        build(controller_recipe(), place / "controller.fmu")
        for name, steps in (("loop", STEPS), ("long", 10 * STEPS)):
            (place / f"{name}.yaml").write_text(SCENARIO.format(duration=steps * H, **NOISE))
        figures: dict[str, float | str] = {
            "loop_over_plain": loop_over_plain(place / "loop.yaml"),
            "fmpy_over_ours_overhead": fmpy_over_ours(place),
            "dormant_over_base": dormant_over_base(),
            "ten_times_the_steps": ten_times_the_steps(place),
            "resume_equal": resume_equal(place),
        }
        if compiler() is not None:
            figures["isolated_over_inprocess"] = isolated_over_inprocess(place)
        figures |= native_figures(place) | peer_figures(place) | library_figures(place) | coupling_figures(place)
    return {name: value if isinstance(value, str) else round(value, 3) for name, value in figures.items()}


def loop_seconds(system: System, steps: int, rows: Rows | None = None) -> float:
    """Return the seconds of the master's steps, without loading."""
    marks: list[float] = []
    simulate(system, steps, H, lambda k: marks.append(time.perf_counter()), rows)
    return (marks[-1] - marks[0]) * steps / (steps - PROGRESS_EVERY_STEPS)


def loop_over_plain(scenario: Path) -> float:
    """Compare the master with plain functions."""
    file = ScenarioFile(scenario)
    return median_ratio(lambda: loop_seconds(build_system(file), STEPS), plain_seconds)


def plain_seconds() -> float:
    """Return the seconds of the loop as plain functions, with equal noise and signals."""
    stepper = Stepper(Hovercraft())
    moment = stepper.start(0.0, {"x": 1.0, "psi": 1.0})
    loop = Loop(Settings(), (1.0, 0.0, 1.0, 0.0, 0.0), 0.0, 0.0)
    duty = loop.settings.duty_nominal
    noise = [gaussian(stream(1, name), variance, 0.0, STEPS + 1) for name, variance in NOISE.items()]
    psi_noise, psi_dot_noise, ax_noise = noise
    table = np.zeros((STEPS + 1, 37))
    command = (duty, duty, *loop.command)
    begin = time.perf_counter()
    for k in range(1, STEPS + 1):
        moment = stepper.step(moment, command, H)
        y = stepper.output(moment.t, moment.state, command)
        measured = (y[4] + psi_noise[k], y[8] + psi_dot_noise[k], y[10] + ax_noise[k])
        command = (duty, duty, *loop.step(measured, 0.0, 0.0))
        table[k] = (*command, *y, *measured, 0.0, 0.0, *command, *loop.estimate, *loop.sigma, 0.0, 0.0)
    return time.perf_counter() - begin


def fmpy_over_ours(place: Path) -> float:
    """Compare a plain FMPy loop with the master, for two idle FMUs."""
    from pythonfmu.builder import FmuBuilder

    for name, inputs, outputs in (("IdleA", 5, 12), ("IdleB", 12, 5)):
        script = place / f"{name.lower()}.py"
        script.write_text(IDLE_SLAVE.format(name=name, inputs=inputs, outputs=outputs))
        FmuBuilder.build_FMU(script, place / f"{name.lower()}.fmu")
    links = [f"  - {{from: {a}.y{k}, to: {b}.u{k}}}" for a, b, n in (("a", "b", 12), ("b", "a", 5)) for k in range(n)]
    text = f"name: idle\nduration: {STEPS * H}\nstep: 0.02\norder: [a, b]\ncomponents:\n"
    text += "  a: {fmu: idlea.fmu}\n  b: {fmu: idleb.fmu}\nconnections:\n" + "\n".join(links) + "\n"
    (place / "idle.yaml").write_text(text)
    file = ScenarioFile(place / "idle.yaml")
    return median_ratio(lambda: fmpy_idle_seconds(place), lambda: loop_seconds(build_system(file), STEPS))


def fmpy_idle_seconds(place: Path) -> float:
    """Return the seconds of an FMPy loop of two idle FMUs."""
    a_in, b_in, a_out, b_out = list(range(5)), list(range(12)), list(range(5, 17)), list(range(12, 17))
    table = np.zeros((STEPS + 1, 34))
    with running(place / "idlea.fmu") as a, running(place / "idleb.fmu") as b:
        values_b = b.getReal(b_out)
        begin = time.perf_counter()
        for k in range(STEPS):
            t = k * H
            a.setReal(a_in, values_b)
            a.doStep(t, H)
            values_a = a.getReal(a_out)
            b.setReal(b_in, values_a)
            b.doStep(t, H)
            old_b, values_b = values_b, b.getReal(b_out)
            table[k + 1] = (*old_b, *values_a, *values_a, *values_b)
        return time.perf_counter() - begin


def dormant_over_base() -> float:
    """Compare plant steps with dormant and without effects."""
    command = (6.4, 6.38, 0.1, 0.05)

    def seconds(craft: Hovercraft) -> float:
        stepper = Stepper(craft)
        moment = stepper.start()
        begin = time.perf_counter()
        for _ in range(200):
            moment = stepper.step(moment, command, H)
        return time.perf_counter() - begin

    dormant = Hovercraft(effects=tuple(kind() for kind in Hovercraft.catalogue))
    return median_ratio(lambda: seconds(dormant), lambda: seconds(Hovercraft()), rounds=51)


def ten_times_the_steps(place: Path) -> float:
    """Return the time ratio of ten times the steps."""
    short, long = ScenarioFile(place / "loop.yaml"), ScenarioFile(place / "long.yaml")
    return median_ratio(
        lambda: loop_seconds(build_system(long), 10 * STEPS), lambda: loop_seconds(build_system(short), STEPS), rounds=5
    )


class _Stop(Observer):
    """Stops a run as a person at the keyboard does, at its first rows."""

    is_stopped = False

    def rows(self, time: Array, values: Array) -> None:
        """Stop once."""
        if not self.is_stopped:
            self.is_stopped = True
            raise KeyboardInterrupt


def resume_equal(place: Path) -> float:
    """Return 1 if a resumed run repeats the bytes, else 0."""
    scenario = place / "long.yaml"
    run(scenario, place / "whole", report=False)
    with suppress(Interrupted):
        run(scenario, place / "part", observers=[_Stop()], report=False)
    run(place / "part", resume=True, report=False)
    part, whole = (place / name / "results.csv" for name in ("part", "whole"))
    return float(part.read_bytes() == whole.read_bytes())


def isolated_over_inprocess(place: Path) -> float:
    """Compare steps in a worker and in this process.

    The system has two C FMUs with 20 variables.
    """
    scenario = lags_scenario(place, MANY, H)
    file, table = ScenarioFile(scenario), place / "rows"
    system = build_system(file)
    columns = len(system.columns)
    watch = Watch([s.component.name for s in system.stages], limits=Limits(step=60.0, memory=1e10), width=8 * columns)
    allocate(table, 8 * (MANY + 1) * columns)
    with Worker(__name__) as other:
        return median_ratio(
            lambda: float(other.call(worker_seconds, scenario, table, watch=watch)),
            lambda: loop_seconds(build_system(file), MANY),
            rounds=5,
        )


def worker_seconds(scenario: Path, table: Path) -> float:
    """Return the seconds of the steps in the worker, rows and counters mapped as in a run."""
    system = build_system(ScenarioFile(scenario))
    mapped, progress = mapped_table(table, MANY + 1, len(system.columns)), worker.progress
    rows = Rows(mapped, made=progress.made, doing=progress.doing)
    return loop_seconds(system, MANY, rows)
