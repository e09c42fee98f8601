"""Connections that convert, exported to SSP as linear transformations or as small FMUs, and read again."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fmpy.ssp.ssd import read_ssd

import cosim
from cosim.fmi.native.signal_source import build_gain

WAYS = [
    ("rpm", "rad/s", {}, math.pi / 30.0, 0.0),
    ("degC", "K", {}, 1.0, 273.15),
    ("m", "m", {"factor": -2.0, "offset": 0.5}, -2.0, 0.5),
]


@pytest.mark.parametrize("insert", [False, True], ids=["transformation", "gain"])
@pytest.mark.parametrize(("unit", "to", "more", "factor", "offset"), WAYS)
def test_a_connection_that_converts_makes_a_round_trip(
    tmp_path: Path, unit: str, to: str, more: dict[str, float], factor: float, offset: float, insert: bool
) -> None:
    first = build_gain("a", (3.0, 0.0), (unit, unit), tmp_path / "a.fmu")
    last = build_gain("b", (1.0, 0.0), (to, to), tmp_path / "b.fmu")
    scenario = f"""
name: chain
duration: 0.1
step: 0.01
algorithm: jacobi
components:
  a: {{fmu: {first}, start: {{u: 20.0}}}}
  b: {{fmu: {last}}}
connections:
  - {{from: a.y, to: b.u, {", ".join(f"{k}: {v}" for k, v in more.items())}}}
"""
    (tmp_path / "chain.yaml").write_text(scenario, encoding="utf-8")
    exported = cosim.export_ssp(tmp_path / "chain.yaml", tmp_path / "chain.ssp", insert_gains=insert)
    with zipfile.ZipFile(exported.path) as archive:
        assert len([name for name in archive.namelist() if name.endswith(".fmu")]) == (3 if insert else 2)
    assert read_ssd(str(exported.path), validate=True).system.connections
    assert any("ignore" in note for note in exported.notes) == (not insert)
    ours, read = cosim.run(tmp_path / "chain.yaml"), cosim.run(exported.path)
    expected = factor * 60.0 + offset
    assert ours["b.y"][-1] == pytest.approx(expected, rel=1e-12)
    settled = slice(3, None)  # every FMU between takes a step
    np.testing.assert_allclose(read["b.y"][settled], ours["b.y"][settled], rtol=1e-12)
