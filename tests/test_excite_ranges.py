"""No experiment commands what an input cannot take: as declared, as asked for, or as the logs have seen it."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from cosim.core.errors import InputError
from cosim.experiment.excite import excite
from cosim.experiment.question import ask

FAN = '''"""A fan in front of a flap."""

from dataclasses import dataclass

from cosim.model import Effect, Equations, Model, Quantity, parameter


@dataclass(frozen=True, kw_only=True)
class Draught(Effect):
    """Air that comes from elsewhere."""

    name = "draught"
    equation = "speed + d"

    speed: float = parameter(0.0, unit="m/s", bounds=(-5, 5), neutral=0.0, typical=0.5, doc="d")


@dataclass(frozen=True, kw_only=True)
class Fan(Model):
    """T·v̇ = k·u − v + d."""

    base_states = (Quantity("wind", "m/s", "of the air"),)
    inputs = (Quantity("fan", "%", "speed of the fan", 20.0BOUNDS),)
    outputs = base_states
    catalogue, forced, calibrated = (Draught,), ("wind",), ("gain",)
    sensor_variance = {"wind": 1e-4}
    gain: float = parameter(0.1, unit="m/s", bounds=(0, 1), doc="k for each percent")

    def equations(self, m):
        """With T = 1 s."""
        draught = sum(e.speed for e in self.awake)
        return Equations(
            lambda t, x, u: (self.gain * u[0] - x[0] + draught,),
            lambda t, x, u: x,
        )
'''


def fan(folder: Path, bounds: str = ", (0.0, 100.0)") -> str:
    (folder / "fan.py").write_text(FAN.replace("BOUNDS", bounds))
    return f"{folder / 'fan.py'}:Fan"


def played(folder: Path) -> dict[str, np.ndarray]:
    with (folder / "excitation.csv").open() as stream:
        header, *rows = csv.reader(stream)
    return dict(zip((h.partition(" [")[0] for h in header), np.array(rows, dtype=float).T, strict=True))


@pytest.mark.parametrize("limits", [[], ["fan=90"]])
def test_a_fan_is_never_told_to_run_backwards(tmp_path: Path, limits: list[str]) -> None:
    found = excite(fan(tmp_path), tmp_path / "out", limits=limits, duration=10.0, experiments=6)
    told = played(tmp_path / "out")["fan"]
    assert told.min() >= 0.0
    assert told.max() <= 100.0
    assert told.max() > 50.0  # it is played all the same
    usual = found.rig.play(found.question.loaded.model, found.rig.usual_signals(found.trial.time)).inputs["fan"]
    assert (usual.min(), usual.max()) == (0.0, 65.0 if limits else 60.0)
    for trial in found.rivals.values():
        assert trial.inputs["fan"].min() >= 0.0


def test_what_is_declared_stands_over_what_is_asked_for(tmp_path: Path) -> None:
    model = fan(tmp_path)
    assert ask(model, ranges=["fan=-10..60"]).ranges == {"fan": (0.0, 60.0)}
    assert ask(model, ranges=["fan=-10..60"]).limits == {"fan": 40.0}  # from where it starts, at 20 %
    assert ask(model, limits=["fan=5"]).ranges == {"fan": (0.0, 100.0)}
    assert ask(model, limits=["fan=5"]).limits == {"fan": 5.0}
    with pytest.raises(InputError, match=r"the model declares 0\.\.100 % of fan"):
        ask(model, ranges=["fan=-10..-5"])
    with pytest.raises(InputError, match="how far from 20 may fan go"):
        ask(fan(tmp_path, ", (0.0, float('inf'))"))
