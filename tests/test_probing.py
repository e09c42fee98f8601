"""Probing of binaries: structure, places and behaviour, of FMUs whose equations and faults are known here."""

from __future__ import annotations

import json
import platform
from pathlib import Path

import numpy as np
import pytest

from cosim.authoring.single import simulate
from cosim.fmi.description import Way
from cosim.fmi.native.compiler import compiler
from cosim.logs.log import Log
from cosim.probing.places import probe_own_step, probe_structure
from cosim.residuals.drive import log_of_fmu
from cosim.verbs.checks import check as check_files
from tests.blind.fmu_build import PLANTS, WAYS, build
from tests.cases import some
from tests.compiled import rewritten
from tests.deeds import deeds_fmu
from tests.slider import slider_fmu, slider_log
from tests.warm import cosim

pytestmark = pytest.mark.skipif(
    compiler() is None or platform.system() != "Linux", reason="needs a C compiler and Linux folders"
)


def log_for(plant: str, step: float = 0.01, rows: int = 400) -> Log:
    """A log of random levels; its outputs are not measured."""
    rng, inputs = np.random.default_rng(1), {}
    for v in PLANTS[plant].inputs:
        inputs[v.name] = v.start + 0.1 * np.repeat(rng.standard_normal(rows // 10), 10)
    return Log(Path("a.csv"), step * np.arange(rows), inputs, {}, {}, step, {}, {})


# -- structure --------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("way", ["model-exchange", "co-simulation"])
def test_a_mass_with_a_force_is_a_pair_with_a_port(tmp_path: Path, version: int, way: Way) -> None:
    fmu = slider_fmu(tmp_path / "slider.fmu", version, exchange=way == "model-exchange")
    structure = probe_structure(fmu, [log_of_fmu(slider_log(tmp_path / "a.csv"), fmu)], way=way)
    (pair,) = structure.pairs
    assert (pair.position, pair.velocity, pair.gain) == ("position", "velocity", 1.0)
    (port,) = pair.ports
    assert port.input == "force"
    # gain/mass; a 32nd of a step of 0.05 s loses h·d/2m of it
    assert port.gain == pytest.approx(2.0, rel=1e-9 if way == "model-exchange" else 2e-3)
    assert structure.depends.all() if way == "co-simulation" else port.is_alone


PLACES = {  # pairs with their ports and gains at rest, and storages, from the equations of tests/blind/fmus
    "heated_box": ({}, ("T_heater", "T_air")),
    "drive": ({("motor.phi", "motor.w"): {"torque": 100.0}, ("load.phi", "load.w"): {}}, ()),
    "coupled": ({("phi1", "w1"): {"torque": 10.0}, ("phi2", "w2"): {}}, ()),
    "tanks": ({}, ("left.h", "right.h")),
    "dc_motor": ({("angle", "speed"): {"load_torque": -5000.0}}, ("current",)),
    "cylinder": ({("piston.x", "piston.v"): {"load": -0.02}}, ("p_a", "p_b")),
    "pendulum": ({("x", "v"): {"force": 1.0}, ("phi", "w"): {"force": -2.0}}, ()),
}


@pytest.mark.parametrize("plant", some(PLACES, every=3))
def test_the_places_of_a_plant_are_those_of_its_equations(tmp_path: Path, plant: str) -> None:
    structure = probe_structure(build(tmp_path / "a.fmu", plant, 3 if plant in {"tanks", "drive"} else 2))
    pairs, storages = PLACES[plant]
    assert {(p.position, p.velocity): {port.input: port.gain for port in p.ports} for p in structure.pairs} == {
        names: {name: pytest.approx(gain, rel=1e-3) for name, gain in ports.items()} for names, ports in pairs.items()
    }
    assert structure.storages == storages
    assert {p.name for p in structure.acting} == {v.name for v in PLANTS[plant].parameters}
    assert [q.unit for q in structure.states] == [v.unit for v in PLANTS[plant].states]
    assert [q.start for q in structure.states] == pytest.approx([v.start for v in PLANTS[plant].states])
    if plant == "pendulum":  # a force on two coupled masses
        assert [port.is_alone for pair in structure.pairs for port in pair.ports] == [False, False]
    if plant == "tanks":  # levels that other outputs show
        assert structure.shown == {"left.h": "gauge_left", "right.h": "gauge_right"}
    if plant == "heated_box":
        matrix = [[-3.0 / 120.0, 3.0 / 120.0], [3.0 / 300.0, -(3.0 + 1.5) / 300.0]]
        assert structure.largest_rate == pytest.approx(np.abs(np.linalg.eigvals(matrix)).max(), rel=1e-6)


@pytest.mark.parametrize(
    ("plant", "feeds"),
    [
        ("tanks", {"gauge_left": ("pump_left", 3e-4), "gauge_right": ("pump_right", 3e-4)}),
        ("cylinder", {}),  # the valve changes both pressures
    ],
)
def test_a_storage_of_co_simulation_has_an_input_of_its_own(
    tmp_path: Path, plant: str, feeds: dict[str, tuple[str, float]]
) -> None:
    structure = probe_structure(build(tmp_path / "a.fmu", plant, ways=WAYS), [log_for(plant)], way="co-simulation")
    assert structure.storages == tuple(feeds)
    for name, (port, gain) in feeds.items():
        assert structure.feeds[name].input == port
        assert structure.feeds[name].gain == pytest.approx(gain, rel=0.02)


def test_time_events_are_counted(tmp_path: Path) -> None:
    logs = [log_for("drive", rows=50)]
    ticking = probe_structure(build(tmp_path / "a.fmu", "drive", fault="time_events"), logs)
    assert [(e.state, e.time, e.step) for e in ticking.events] == [(0, 490, 0)]  # each millisecond


# -- steps of its own and misbehaviour ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "step", "own"), [("", 0.01, None), ("hidden_own_step", 0.01, 0.05), ("hidden_own_step", 0.1, None)]
)
def test_a_step_of_its_own_above_those_of_the_log_is_found(
    tmp_path: Path, fault: str, step: float, own: float | None
) -> None:
    fmu = build(tmp_path / "a.fmu", "drive", 3 if fault else 2, ways=WAYS, fault=fault)
    found = probe_own_step(fmu, [log_for("drive", step=step)])
    assert (found and found.length) == own


@pytest.mark.parametrize(
    ("fault", "count"), [("", 0), ("idle_reset", 1), ("leaks", 1), ("counts", 1), ("working_directory", 2)]
)
def test_a_check_of_an_fmu_warns_of_its_misbehaviour(tmp_path: Path, fault: str, count: int) -> None:
    fmu = build(tmp_path / "a.fmu", "drive", 3 if fault == "idle_reset" else 2, ways=WAYS, fault=fault)
    assert sum(": warning: " in text for text in check_files(fmu)) == count


def test_a_name_that_stands_twice_is_a_warning_and_means_its_first_variable(tmp_path: Path) -> None:
    fmu, twice = slider_fmu(tmp_path / "slider.fmu"), tmp_path / "twice.fmu"
    rewritten(fmu, twice, lambda name, data: data.replace(b'name="velocity"', b'name="position"'))
    assert any("position" in text and ": warning: " in text for text in check_files(twice))
    once, again = (simulate(path, tmp_path / path.stem, {"force": 1.0}, stop=1.0) for path in (fmu, twice))
    assert np.array_equal(again.to_pandas()["twice.position"], once.to_pandas()["slider.position"])


# -- places -----------------------------------------------------------------------------------------


def test_the_verb_shows_places_as_a_table_and_as_json(tmp_path: Path) -> None:
    fmu = build(tmp_path / "motor.fmu", "dc_motor", ways=WAYS)
    assert "angle" in cosim("info", fmu, "--places").stdout
    places = json.loads(cosim("info", fmu, "--places", "--json").stdout)["places"]
    assert [(p["position"], p["velocity"]) for p in places["pairs"]] == [("angle", "speed")]
    assert [s["name"] for s in places["storages"]] == ["current"]
    assert {p["name"]: p["acts"] for p in places["parameters"]}["damping"] is True
    assert (places["findings"], places["own_step"]) == ([], 0.0)


def test_an_fmu_that_fails_soon_has_no_places_and_is_named(tmp_path: Path) -> None:
    for call, deed, at in (("DoStep", "end", 3), ("GetReal", "error", 5)):
        told = cosim("info", deeds_fmu(tmp_path / f"{call}.fmu", call, deed, at), "--places")
        assert told.returncode == 4
        assert f"{call}.fmu" in told.stderr
