"""A valve as somebody would hand it in: mass flow over opening and pressure drop, no states; tables of real ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array

VALVE = '''"""A valve."""

from dataclasses import dataclass

from cosim.model import Bias, Effect, Equations, Model, Quantity, overrides, parameter


class ValveEffect(Effect):
    def passing(self, m, opening):
        return opening


@dataclass(frozen=True, kw_only=True)
class SeatLeak(ValveEffect):
    """The seat does not close."""

    name = "seat_leak"
    equation = "opening + l"

    share: float = parameter(0.0, unit="1", bounds=(0, 0.5), neutral=0.0, typical=0.02, doc="opening l that is left")

    def passing(self, m, opening):
        return opening + self.share


@dataclass(frozen=True, kw_only=True)
class Bow(ValveEffect):
    """The plug is not linear."""

    name = "bow"
    equation = "opening + b*opening*(1 - opening)"

    share: float = parameter(0.0, unit="1", bounds=(-1, 1), neutral=0.0, typical=0.1, doc="bow b")

    def passing(self, m, opening):
        return opening + self.share * opening * (1.0 - opening)


@dataclass(frozen=True, kw_only=True)
class MeterOffset(Bias):
    """The flow meter was not zeroed."""

    name = "meter_offset"
    output = "flow"

    value: float = parameter(0.0, unit="kg/s", bounds=(-1, 1), neutral=0.0, typical=0.1, doc="offset")


@dataclass(frozen=True, kw_only=True)
class Valve(Model):
    """Mass flow of a valve: c*opening*sqrt(drop)."""

    base_states = ()
    inputs = (Quantity("opening", "1", "opening", 0.5), Quantity("drop", "Pa", "pressure drop", 1e5))
    outputs = (Quantity("flow", "kg/s", "mass flow"),)
    catalogue = (SeatLeak, Bow)
    sensors = (MeterOffset,)
    sensor_variance = {"flow": 1e-4}
    calibrated = ("coefficient",)

    coefficient: float = parameter(0.01, unit="1", bounds=(1e-4, 1), tolerance=0.1, doc="flow coefficient c")

    def equations(self, m):
        terms = overrides(self.awake, "passing", ValveEffect)

        def derivative(t, state, command):
            return ()

        def output(t, state, command):
            opening, drop = command
            for term in terms:
                opening = term.passing(m, opening)
            return (self.coefficient * opening * m.sqrt(drop),)

        return Equations(derivative, output)
'''
NOISE = 0.01  # [kg/s]
Truth = Callable[[Array, Array], Array]  # flow [kg/s] of opening and pressure drop [Pa]


def measured(truth: Truth, rows: int, seed: int) -> tuple[Array, Array, Array]:
    """Opening, drop and flow at points drawn by a seed."""
    rng = np.random.default_rng(seed)
    opening, drop = rng.uniform(0.05, 1.0, rows).round(3), rng.choice([0.5e5, 1e5, 2e5], rows)
    return opening, drop, truth(opening, drop) + NOISE * rng.standard_normal(rows)


def write(path: Path, opening: Array, drop: Array, flow: Array, header: str = "drop [kPa],flow,opening") -> None:
    """Write a table with columns in an order different from the model's, and a column with a different unit."""
    rows = (f"{d / 1000:.6g},{q:.6f},{o:.6g}" for o, d, q in zip(opening, drop, flow, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def study_of(folder: Path, truth: Truth, rows: int = 24, sealed: int = 0, seed: int = 1) -> Path:
    """study.yaml with the model and tables of a real valve."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "valve.py").write_text(VALVE, encoding="utf-8")
    write(folder / "a.csv", *measured(truth, rows, seed))
    logs = "  estimation: [a.csv]\n"
    if sealed:
        write(folder / "v.csv", *measured(truth, sealed, seed + 100))
        logs += "  validation: [v.csv]\n"
    path = folder / "study.yaml"
    path.write_text(f"model: valve.py:Valve\nlogs:\n{logs}", encoding="utf-8")
    return path
