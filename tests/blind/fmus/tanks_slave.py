"""The two tanks by another exporter, pythonfmu: equations written again, co-simulation of FMI 2.0, no units."""

from functools import partial
from math import sqrt
from typing import Any

from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real

INNER = 0.5  # largest Runge-Kutta step [s]
STARTS = {"left.h": 0.3, "right.h": 0.25}
PARAMETERS = {
    "left.area": 0.02, "right.area": 0.02, "pipe.k": 1.2e-4, "outlet.k": 1.2e-4, "gain_left": 6e-6, "gain_right": 6e-6,
}  # fmt: skip


class TanksSlave(Fmi2Slave):  # type: ignore[misc]  # pythonfmu is untyped
    """Two tanks joined by a pipe."""

    author = "tests"
    description = "Two tanks joined by a pipe"

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.values = {"pump_left": 5.0, "pump_right": 5.0, **STARTS, **PARAMETERS}
        for name in ("pump_left", "pump_right"):
            self._register(name, causality=Fmi2Causality.input)
        for name in STARTS:
            self._register(name, causality=Fmi2Causality.local, initial=Fmi2Initial.exact)
        for name, level in (("gauge_left", "left.h"), ("gauge_right", "right.h")):
            gauge = Real(name, causality=Fmi2Causality.output, getter=partial(self.values.__getitem__, level))
            self.register_variable(gauge)
        fixed = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
        for name in PARAMETERS:
            self._register(name, **fixed)

    def _register(self, name: str, **attributes: Any) -> None:
        get, put = partial(self.values.__getitem__, name), partial(self.values.__setitem__, name)
        self.register_variable(Real(name, getter=get, setter=put, **attributes))

    def _rates(self, left: float, right: float) -> tuple[float, float]:
        v = self.values
        across = _flow(v["pipe.k"], left - right)
        rise = v["gain_left"] * v["pump_left"] - across
        return rise / v["left.area"], (v["gain_right"] * v["pump_right"] + across - _flow(v["outlet.k"], right)) / v[
            "right.area"
        ]

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Make one communication step in Runge-Kutta steps of order 4."""
        count = max(1, -int(-step_size / INNER // 1))
        h = step_size / count
        a, b = self.values["left.h"], self.values["right.h"]
        for _ in range(count):
            k1 = self._rates(a, b)
            k2 = self._rates(a + 0.5 * h * k1[0], b + 0.5 * h * k1[1])
            k3 = self._rates(a + 0.5 * h * k2[0], b + 0.5 * h * k2[1])
            k4 = self._rates(a + h * k3[0], b + h * k3[1])
            a += h / 6.0 * (k1[0] + 2.0 * k2[0] + 2.0 * k3[0] + k4[0])
            b += h / 6.0 * (k1[1] + 2.0 * k2[1] + 2.0 * k3[1] + k4[1])
        self.values["left.h"], self.values["right.h"] = a, b
        return True


def _flow(k: float, fall: float) -> float:
    """Return the flow for a difference of levels, linear near 0."""
    return k * fall / sqrt(sqrt(fall * fall + 1e-4))
