"""Parameters of the running controller, declared once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from cosim.model import Parameter, parameter, parameters_of
from cosim.model.model import Parametric
from plant.hovercraft import SENSOR_VARIANCE, Hovercraft

ESTIMATORS = ("appendix_f", "lagged", "consistent")
GAINS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in range(1, 6))  # K, row by row
CRAFT = {p.name: p for p in parameters_of(Hovercraft)}

# Eq 6.5 with all digits: LQR gain of eqs 5.33/5.34 with the weights of eq 6.4. A test repeats the design.
K_X = math.sqrt(0.5)
K_VX = 0.6593433035062245
K_PSI = math.sqrt(0.05)
K_PSI_DOT = 0.1016985602839789
K_A = 0.0495788342133304


def gain(default: float, tilt: str, state: str) -> float:
    """Declare an entry of K: tilt command [rad] per unit of a state."""
    unit = {"x": "rad/m", "vx": "rad.s/m", "psi": "1", "psi_dot": "s", "a": "rad.s2/m"}[state]
    value: float = parameter(
        default, unit=unit, bounds=(-1e4, 1e4), doc=f"gain from {state} to the {tilt} tilt, eq 6.5"
    )
    return value


def declared(by: Mapping[str, Parameter], name: str, of: str = "") -> Any:
    """Declare a parameter of another class again, with a prefix `of` in its meaning."""
    p = by[name]
    return parameter(p.default, unit=p.unit, bounds=p.bounds, doc=of + p.doc)


def of_craft(name: str) -> Any:
    """Declare a design model parameter like the plant's."""
    return declared(CRAFT, name, "design model: ")


def variance(default: float, unit: str, doc: str) -> float:
    """Declare a noise variance."""
    value: float = parameter(default, unit=unit, bounds=(0, 1e6), doc=doc)
    return value


@dataclass(frozen=True, kw_only=True)
class Settings(Parametric):
    """Parameters of the controller FMU; the estimator is one of `estimators`."""

    estimators: ClassVar[tuple[str, ...]] = ESTIMATORS

    k_1_1: float = gain(K_X, "right", "x")
    k_1_2: float = gain(K_VX, "right", "vx")
    k_1_3: float = gain(K_PSI, "right", "psi")
    k_1_4: float = gain(K_PSI_DOT, "right", "psi_dot")
    k_1_5: float = gain(K_A, "right", "a")
    k_2_1: float = gain(K_X, "left", "x")
    k_2_2: float = gain(K_VX, "left", "vx")
    k_2_3: float = gain(-K_PSI, "left", "psi")
    k_2_4: float = gain(-K_PSI_DOT, "left", "psi_dot")
    k_2_5: float = gain(K_A, "left", "a")

    mass: float = of_craft("mass")
    izz: float = of_craft("izz")
    arm: float = of_craft("arm")
    friction: float = of_craft("friction")
    lag: float = of_craft("lag")
    duty_nominal: float = of_craft("duty_nominal")
    thrust_nominal: float = parameter(
        2.4973, unit="N", bounds=(0.01, 100), doc="design model: thrust per propeller in ground effect T_N, eq 5.36"
    )
    yaw_damping: float = parameter(
        0.0, unit="N.m.s/rad", bounds=(0, 10), doc="design model: viscous yaw moment per yaw rate; the thesis has none"
    )
    sample_time: float = parameter(0.02, unit="s", bounds=(1e-4, 1), doc="sample time, Fig 4.8")
    tilt_max: float = parameter(math.radians(12), unit="rad", bounds=(0, math.pi / 2), doc="tilt saturation, App G")

    process_variance_x: float = variance(1e-4, "m2", "process noise of x per step, eq 5.47")
    process_variance_vx: float = variance(1e-4, "m2/s2", "process noise of vx per step, eq 5.47")
    process_variance_psi: float = variance(2.613e-5, "rad2", "process noise of psi per step, eq 5.47")
    process_variance_psi_dot: float = variance(4.564e-4, "rad2/s2", "process noise of psi_dot per step, eq 5.47")
    process_variance_a: float = variance(1e-4, "m2/s4", "process noise of the thrust acceleration per step, eq 5.47")
    measurement_variance_psi: float = variance(SENSOR_VARIANCE["psi"], "rad2", "measurement noise of psi, eq 5.46")
    measurement_variance_psi_dot: float = variance(
        SENSOR_VARIANCE["psi_dot"], "rad2/s2", "measurement noise of psi_dot, eq 5.46"
    )
    measurement_variance_ax: float = variance(SENSOR_VARIANCE["ax"], "m2/s4", "measurement noise of ax, eq 5.46")
    measurement_variance_x: float = variance(1e-4, "m2", "noise of a fix of x; the thesis has no fixes, §7.1")
    fix_latency: float = parameter(0.0, unit="s", bounds=(0, 1), doc="how old a fix is when it arrives, §7.1")

    estimator: str = "appendix_f"

    def __post_init__(self) -> None:
        faults = []
        try:
            super().__post_init__()
        except ValueError as error:
            faults.append(str(error))
        if self.estimator not in self.estimators:
            allowed = f"it is {'one of ' * (len(self.estimators) > 1)}{', '.join(self.estimators)}"
            faults.append(f"estimator is {self.estimator!r}; {allowed}")
        if faults:
            raise ValueError("; ".join(faults))

    @property
    def gain_matrix(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return K, shape (2, 5)."""
        right = (self.k_1_1, self.k_1_2, self.k_1_3, self.k_1_4, self.k_1_5)
        return right, (self.k_2_1, self.k_2_2, self.k_2_3, self.k_2_4, self.k_2_5)

    @property
    def process_variances(self) -> tuple[float, ...]:
        """Return the diagonal of V, eq 5.47, shape (5,)."""
        return (
            self.process_variance_x,
            self.process_variance_vx,
            self.process_variance_psi,
            self.process_variance_psi_dot,
            self.process_variance_a,
        )

    @property
    def measurement_variances(self) -> tuple[float, ...]:
        """Return the diagonal of W, eq 5.46, shape (3,)."""
        return self.measurement_variance_psi, self.measurement_variance_psi_dot, self.measurement_variance_ax

    @property
    def fix_variances(self) -> tuple[float, ...]:
        """Return the noise diagonal of a fix, shape (1,)."""
        return (self.measurement_variance_x,)
