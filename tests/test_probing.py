"""Probing of binaries: structure, places and behaviour, from FMUs whose equations are known here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cosim.blocks.description import Way
from cosim.logs.log import Log
from cosim.probing.probe_structure import probe_structure
from cosim.residuals.drive import log_of_fmu
from tests.slider import slider_fmu, slider_log


def log_for(fmu: Path, path: Path) -> Log:
    return log_of_fmu(slider_log(path), fmu)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("with_log", [False, True])
def test_a_mass_with_a_force_is_a_pair_with_a_port(tmp_path: Path, version: int, with_log: bool) -> None:
    fmu = slider_fmu(tmp_path / "slider.fmu", version, exchange=True)
    structure = probe_structure(fmu, [log_for(fmu, tmp_path / "a.csv")] if with_log else ())
    assert structure.state_in_rate.tolist() == [[False, True], [False, True]]
    assert structure.input_in_rate.tolist() == [[False], [True]]
    assert structure.state_in_output.tolist() == [[True, False], [False, True]]
    assert not structure.input_in_output.any()
    (pair,) = structure.pairs
    assert (pair.position, pair.velocity, pair.gain) == ("position", "velocity", 1.0)
    (port,) = pair.ports
    assert (port.input, port.is_alone) == ("force", True)
    assert port.gain == pytest.approx(2.0, rel=1e-9)  # gain/mass
    assert structure.storages == ()
    assert structure.shown == {"position": "position", "velocity": "velocity"}
    assert structure.largest_rate == pytest.approx(0.5, rel=1e-6)  # damping/mass
    assert [e.total for e in structure.events] == [0]
    assert {p.name for p in structure.acting} == {"mass", "gain", "damping", "offset"}
    assert [p.name for p in structure.parameters if p.starts] == ["velocity_start"]
    assert [q.unit for q in structure.states] == ["m", "m/s"]


@pytest.mark.parametrize("version", [2, 3])
def test_outputs_of_co_simulation_are_a_pair_by_their_numbers(tmp_path: Path, version: int) -> None:
    fmu = slider_fmu(tmp_path / "slider.fmu", version)
    way: Way = "co-simulation"
    structure = probe_structure(fmu, [log_for(fmu, tmp_path / "a.csv")], way=way)
    (pair,) = structure.pairs
    assert (pair.position, pair.velocity, pair.gain) == ("position", "velocity", 1.0)
    (port,) = pair.ports
    assert port.input == "force"
    assert port.gain == pytest.approx(2.0, rel=0.05)  # a step of 0.05 s loses h·d/2m of it
    assert structure.input_in_output.all()
    assert "idle" not in {p.name for p in structure.acting}
    assert np.isfinite([*structure.scales.values()]).all()
