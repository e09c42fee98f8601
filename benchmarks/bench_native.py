"""Benchmarks of the native craft loop against FMPy, manual C and ecos, as ratios of CPU time.

All are Jacobi without noise and record the same 20 variables; `cosim run` also records inputs and performs its checks.
CPU time of the thread is used, because these loops never wait, and other work on the machine must not count.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np

from benchmarks.measure import Seconds, median_ratio, running
from cosim.credibility.bands import Bands
from cosim.credibility.record import Credibility, attach
from cosim.credibility.region import Stretch, region_of
from cosim.credibility.valid_output import add_valid_output
from cosim.files.results import Results
from cosim.fmi.building.build import build_native
from cosim.fmi.native.compiler import compiler, load_library
from cosim.master.master import PROGRESS_EVERY_STEPS, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import System, build_system

H, STEPS = 0.02, 5000
DRIVER = Path(__file__).with_name("bench_native.c")
START = {"plant": {"x_start": 1.0, "psi_start": 1.0}, "controller": {"x_hat_start": 1.0, "psi_hat_start": 1.0}}
INPUTS = {
    "plant": ("duty_right", "duty_left", "tilt_right", "tilt_left"),
    "controller": ("psi", "psi_dot", "ax"),
}
OUTPUT_COUNT = {"plant": 15, "controller": 5}  # number of first outputs read: the controller's commands and x_hat
PSI, PSI_DOT, AX = 4, 8, 10  # indices among the plant's outputs
SCENARIO = """name: native
duration: {duration}
step: 0.02
algorithm: jacobi
components:
  plant: {{fmu: plant-native.fmu, start: {{x_start: 1, psi_start: 1}}}}
  controller: {{fmu: controller-native.fmu, start: {{x_hat_start: 1, psi_hat_start: 1}}}}
connections:
{links}"""
LINKS = [("plant", name, "controller") for name in INPUTS["controller"]]
LINKS += [("controller", name, "plant") for name in INPUTS["plant"]]
FIGURES = (
    "native_fmpy_over_ours",
    "native_fmpy_over_ours_without_compiler",
    "native_over_c",
    "ecos_over_ours",
    "ecos_csv_over_ours",
    "python_over_native_plant",
    "valid_over_native",
    "valid_over_native_outside",
)


def native_figures(place: Path) -> dict[str, float | str]:
    """Return each ratio by name, or the reason for a missing one."""
    if compiler() is None:
        return dict.fromkeys(FIGURES, "no C compiler")
    scenario = native_scenario(place, STEPS * H)
    system = build_system(ScenarioFile(scenario))
    ours, python_loop = (partial(loop_seconds, system, in_c=in_c) for in_c in (True, False))
    fmpy_loop = partial(fmpy_seconds, place)
    return {
        "native_fmpy_over_ours": median_ratio(fmpy_loop, ours),
        "native_fmpy_over_ours_without_compiler": median_ratio(fmpy_loop, python_loop),
        "native_over_c": median_ratio(ours, partial(c_seconds, place)),
        **ecos_figures(place, ours),
        "python_over_native_plant": python_over_native_plant(place),
        **valid_figures(place, scenario, ours),
    }


def native_scenario(place: Path, duration: float) -> Path:
    """Build the native craft and write the scenario of its loop; return its file."""
    build_native(place, "hovercraft")
    links = "".join(f"  - {{from: {a}.{name}, to: {b}.{name}}}\n" for a, name, b in LINKS)
    scenario = place / "native.yaml"
    scenario.write_text(SCENARIO.format(duration=duration, links=links))
    return scenario


def loop_seconds(system: System, *, in_c: bool) -> float:
    """Return the seconds of the master's steps."""
    marks: list[float] = []
    results = simulate(system, STEPS, H, lambda k: marks.append(time.thread_time()), in_c=in_c)
    assert results.loop.startswith("C" if in_c else "Python"), results.loop
    return (marks[-1] - marks[0]) * STEPS / (STEPS - PROGRESS_EVERY_STEPS)


# -- FMPy -------------------------------------------------------------------------------------------


@contextmanager
def running_craft(place: Path) -> Iterator[list[Any]]:
    """Yield plant and controller in FMPy, with references of their inputs and first outputs."""
    with ExitStack() as stack:
        parts = []
        for name, inputs in INPUTS.items():
            part = stack.enter_context(running(place / f"{name}-native.fmu", start=START[name]))
            part.inputs = [part.references[n] for n in inputs]
            part.outputs = [part.references[n] for n in part.output_names[: OUTPUT_COUNT[name]]]
            parts.append(part)
        yield parts


def fmpy_seconds(place: Path) -> float:
    """Return the seconds of setReal, doStep, getReal in FMPy."""
    table = np.zeros((STEPS + 1, 20))
    with running_craft(place) as (plant, controller):
        y, u = plant.getReal(plant.outputs), controller.getReal(controller.outputs)
        begin = time.thread_time()
        for k in range(STEPS):
            t = k * H
            plant.setReal(plant.inputs, u[:4])
            controller.setReal(controller.inputs, [y[PSI], y[PSI_DOT], y[AX]])
            plant.doStep(t, H)
            controller.doStep(t, H)
            y, u = plant.getReal(plant.outputs), controller.getReal(controller.outputs)
            table[k + 1] = (*y, *u)
        return time.thread_time() - begin


# -- C by hand --------------------------------------------------------------------------------------


class _Part(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in ("instance", "set", "get", "step", "inputs", "outputs"))


def c_seconds(place: Path) -> float:
    """Return the seconds of an independent C loop."""
    drive = load_library(DRIVER.read_text(encoding="utf-8")).drive
    drive.argtypes = [*[ctypes.POINTER(_Part)] * 2, ctypes.c_long, ctypes.c_double, ctypes.c_void_p]
    table = np.zeros((STEPS + 1, 20))
    with running_craft(place) as craft:
        parts, arrays = [], []
        for fmu in craft:
            references = [(ctypes.c_uint * len(r))(*r) for r in (fmu.inputs, fmu.outputs)]
            names = ("fmi2SetReal", "fmi2GetReal", "fmi2DoStep")
            functions = [ctypes.cast(getattr(fmu.dll, name), ctypes.c_void_p).value for name in names]
            parts.append(_Part(fmu.component, *functions, *map(ctypes.addressof, references)))
            arrays.append(references)  # must outlive the loop
        begin = time.thread_time()
        drive(*map(ctypes.byref, parts), STEPS, H, table.ctypes.data)
        return time.thread_time() - begin


# -- ecos -------------------------------------------------------------------------------------------


def ecos_figures(place: Path, ours: Seconds) -> dict[str, float | str]:
    """Compare ecos with the master: all steps by one call, then with its writer of CSV for the 20 variables.

    Without the writer ecos records nothing, the master does.
    """
    names = ("ecos_over_ours", "ecos_csv_over_ours")
    for library in sorted((Path(sys.prefix) / "lib").glob("libtbb.so*")):
        with suppress(OSError):
            ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)  # required by ecos, outside the search path
    try:
        from ecospy.lib import EcosLib
    except (ImportError, OSError) as error:
        return dict.fromkeys(names, f"no ecos ({error}); the extra bench has it")
    EcosLib.set_log_level("err")
    with running_craft(place) as craft:
        parts = zip(INPUTS, craft, strict=True)
        recorded = [(n, o) for n, part in parts for o in part.output_names[: OUTPUT_COUNT[n]]]
    columns = [".".join(name) for name in recorded]
    rows = recorded_rows(place, columns)

    def ours_with_csv() -> float:
        begin = time.thread_time()
        rows.write(place / "ours.csv")
        return ours() + time.thread_time() - begin

    with ecos_run(place) as plain, ecos_run(place, ["::".join(name) for name in recorded]) as writing:
        figures = median_ratio(plain, ours), median_ratio(writing, ours_with_csv)
    return dict(zip(names, figures, strict=True))


def recorded_rows(place: Path, columns: list[str]) -> Results:
    """Return the results of the craft's loop for some columns."""
    results = simulate(build_system(ScenarioFile(place / "native.yaml")), STEPS, H)
    values = np.column_stack([results[name] for name in columns])
    return replace(results, columns=tuple(columns), values=values, whole=frozenset())


@contextmanager
def ecos_run(place: Path, written: list[str] | None = None) -> Iterator[Seconds]:
    """Yield a function that makes the steps in ecos and returns their processor time; ecos uses its own threads."""
    from ecospy import EcosSimulation, EcosSimulationStructure

    with EcosSimulationStructure() as structure:
        for name in INPUTS:
            structure.add_model(name, str(place / f"{name}-native.fmu"))
        for a, name, b in LINKS:
            structure.make_real_connection(f"{a}::{name}", f"{b}::{name}")
        starts = {f"{name}::{key}": value for name, values in START.items() for key, value in values.items()}
        structure.add_parameter_set("start", starts)
        with EcosSimulation(structure=structure, step_size=H) as simulation:
            if written is not None:
                simulation.add_csv_writer(str(place / "ecos.csv"), identifiers=written)
            simulation.init(parameter_set="start")

            def seconds() -> float:
                begin = time.process_time()
                simulation.step(STEPS)
                return time.process_time() - begin

            yield seconds


# -- the output `valid` -----------------------------------------------------------------------------


def valid_figures(place: Path, scenario: Path, ours: Seconds) -> dict[str, float]:
    """Compare steps of the loop whose plant has the output `valid`, inside and outside the region, with the loop."""
    rows, figures = simulate(build_system(ScenarioFile(scenario)), STEPS, H), {}
    signals = {column.removeprefix("plant."): rows[column] for column in rows.columns if column.startswith("plant.")}
    inside = region_of([Stretch(rows.time[:900], {n: v[:900] for n, v in signals.items()})], INPUTS["plant"], {}, H)
    outside = inside.model_copy(deep=True)
    outside.coordinates[-1].low += 100.0 * inside.coordinates[-1].scale
    for name, region in (("valid_over_native", inside), ("valid_over_native_outside", outside)):
        folder = place / name
        folder.mkdir()
        for file in ("plant-native.fmu", "controller-native.fmu", scenario.name):
            copyfile(place / file, folder / file)
        text = {"command": "cosim fit", "model": "craft", "verdict": "unchanged", "sentence": "No fit."}
        record = Credibility(**text, logs=[], region=region, bands=Bands(reason="no replays"))
        attach(folder / "plant-native.fmu", record)
        add_valid_output(folder / "plant-native.fmu", folder / "valid")
        copyfile(folder / "valid" / "plant-native.fmu", folder / "plant-native.fmu")
        system = build_system(ScenarioFile(folder / scenario.name))
        figures[name] = median_ratio(partial(loop_seconds, system, in_c=True), ours)
    return figures


# -- the plant in Python ----------------------------------------------------------------------------


def python_over_native_plant(place: Path) -> float:
    """Compare fmi2DoStep of the Python and the native plant."""

    def seconds(name: str, steps: int) -> float:
        with running(place / name, start=START["plant"]) as fmu:
            begin = time.thread_time()
            for k in range(steps):
                fmu.fmi2DoStep(fmu.component, k * H, H, 1)
            return (time.thread_time() - begin) / steps

    return median_ratio(lambda: seconds("plant.fmu", STEPS // 5), lambda: seconds("plant-native.fmu", STEPS))
