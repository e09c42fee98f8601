"""A known signal value applies from its time to the next, for any step size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from tests.instants import CONSTANT, instants_fmu
from tests.known.kit import Model
from tests.known.sources import GRID, INTEGRATORS
from tests.known.table import ALGORITHMS, WAYS, part, recorded, reference, run

JUMP, AFTER = (GRID > 0.95).astype(float), np.maximum(0, GRID - 1)  # u, which is 1 from 1 s on, and its integral
SOURCES = {"reference": reference(0, {"at": 1, "to": 1}), "playback": recorded("time,u", (0, 0), (1, 1), (2, 1))}
KINDS = {f"{way}_{name.split()[0]}": part(m, 2, way) for name, m in INTEGRATORS.items() for way in WAYS}
COMPILED = [kind for kind in KINDS if kind.startswith("cs")]
SENSOR = {"sensor": {"block": "fix", "rate": 10, "signals": {"u": {}}}, "cs_fixed": KINDS["cs_declared"]}
CONTROLLED = {"max": 0.1, "min": 0.01, "tolerance": 1e-3}


def near(found: Any, wanted: Any) -> None:
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize(
    ("begins", "kinds", "more"),
    [
        ("C", COMPILED, {}),
        ("C, but in Python: me_", KINDS, {}),
        (
            "C, but in Python: sensor",
            KINDS,
            {"beside": SENSOR, "wires": ", r.u > sensor.u, sensor.u_meas > cs_fixed.u"},
        ),
        ("Python: steps", KINDS, {"step": CONTROLLED}),
        ("Python: steps", COMPILED, {"step": CONTROLLED | {"estimator": "halving"}}),
        ("C, but in Python: me_", KINDS, {"extrapolate": "linear", "interpolate": "linear"}),
        (
            "Python: event mode",
            KINDS,
            {"beside": {"clock": {"fmu": lambda f: str(instants_fmu(f / "c.fmu", CONSTANT))}}},
        ),
    ],
)
def test_a_source_acts_from_its_time(
    tmp_path: Path, begins: str, kinds: Any, more: dict[str, Any], source: str, algorithm: str
) -> None:
    """By FMUs of x' = u, y = x + u or y = x."""
    keys = {"beside": {}, "wires": "", "algorithm": algorithm} | more
    components = {"r": SOURCES[source], **{kind: KINDS[kind] for kind in kinds}, **keys.pop("beside")}
    wires = ", ".join(f"r.u > {kind}.u" for kind in kinds) + keys.pop("wires")
    ran = cosim.run(run(components, wires, **keys).written(tmp_path), in_process=True)
    assert ran.manifest["loop"].startswith(begins)
    for name in (name for name in components if name[:3] in ("cs_", "me_")):
        assert ran[f"{name}.u"].tolist() == JUMP.tolist()
        near(ran[f"{name}.x"], AFTER)
        near(ran[f"{name}.y"], AFTER + JUMP * (not name.endswith("no")))


def test_a_source_acts_from_its_time_on_the_members_of_a_loop(tmp_path: Path) -> None:
    """y_a = x_a + u + u_a and u_a = −y_b/2, of the same time."""
    member = Model("input u = 0, input w = 0, x = 0, y", "x' = u + w", "y = x + u + w;", {"y": ("u", "w")})
    components = {"a": part(member), "b": part(member, 2, "me"), "r": SOURCES["reference"]}
    factors = {"a.y > b.u": {"factor": 0.5}, "b.y > a.u": {"factor": -0.5}}
    ran = cosim.run(run(components, {"r.u > a.w": {}, "r.u > b.w": {}, **factors}).written(tmp_path), in_process=True)
    for name in "ab":
        driven = ran[f"{name}.u"] + JUMP
        near(np.diff(ran[f"{name}.x"]), 0.1 * driven[:-1])
        near(ran[f"{name}.y"], ran[f"{name}.x"] + driven)
    near(ran["a.u"], -0.5 * ran["b.y"])
    near(ran["b.u"], 0.5 * ran["a.y"])


@pytest.mark.parametrize(("interpolation", "before"), [("held", 0.0), ("linear", 0.9)])
def test_reals_alone_are_interpolated_and_equal_times_are_a_jump(
    tmp_path: Path, interpolation: str, before: float
) -> None:
    """The last of equal rows acts from their time on; a line before them ends at the first."""
    whole = Model("input u = 0, input Int32 n = 0, x = 0, Int32 m", "x' = u", "m = n;", {"m": ("n",)})
    source = recorded("time,u,n", (0, 0, 0), (1, 1, 3), (1, 7, 6), (1, 5, 4), (2, 5, 5), interpolation=interpolation)
    content = run({"m": part(whole), "r": source}, "r.u > m.u, r.n > m.n").written(tmp_path)
    ran = cosim.run(content)
    assert ran["m.u"][9] == pytest.approx(before)
    assert set(ran["m.u"][10:]) == {5.0}
    assert ran["m.m"].tolist() == [0] * 10 + [4] * 10 + [5]
