"""Parameters of controllers other than the LQR: common estimator and model, own law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from controller.gains import GAINS, Settings
from cosim.model import parameter

# control laws; "" is the LQR
POLES, INTEGRAL, PREDICTIVE, TIME_VARIANT = ("poles", "integral", "predictive", "time_variant")
PREDICTIONS = (PREDICTIVE, TIME_VARIANT)
INTEGRALS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in (6, 7))  # K_i, row by row

# Gains of the poles -2, -4, -11 (forward) and -4, -5 rad/s (turn), and of the LQR with integral weights 0.3 and 0.05.
# Tests repeat the design.
PLACED = (1.098053097345133, 0.8497106634030005, 0.2389282086946114, 0.10751769391257515, 0.06654667040403645)
WITH_INTEGRAL = (1.065117707211288, 0.7494112674097084, 0.2908023505812724, 0.10930731206491429, 0.05538288175826896)
OF_X_INTEGRAL, OF_PSI_INTEGRAL = 0.3872983346207414, 0.15811388300841878


def integral_gain(default: float, tilt: str, unit: str, of: str) -> Any:
    """Declare the gain from an integral to a tilt."""
    return parameter(default, unit=unit, bounds=(-1e4, 1e4), doc=f"gain from the integral of {of} to the {tilt} tilt")


def weight(default: float, unit: str, doc: str) -> Any:
    """Declare a weight of the predictive law."""
    return parameter(default, unit=unit, bounds=(0, 1e6), doc=f"weight of {doc}")


def mirrored(row: Sequence[float]) -> dict[str, Any]:
    """Return ten gains from the right tilt's five; ψ and ψ̇ change sign for the left."""
    signs = (1.0, 1.0, -1.0, -1.0, 1.0)
    left = (sign * k for sign, k in zip(signs, row, strict=True))
    return dict(zip(GAINS, (*row, *left), strict=True))


def placed_settings() -> Settings:
    """Return the settings of pole placement."""
    return replace(Settings(), **mirrored(PLACED))


@dataclass(frozen=True, kw_only=True)
class IntegralSettings(Settings):
    """Parameters of the LQR with integrals of measured x and ψ as states six and seven."""

    k_1_6: float = integral_gain(OF_X_INTEGRAL, "right", "rad/m/s", "x")
    k_1_7: float = integral_gain(OF_PSI_INTEGRAL, "right", "1/s", "psi")
    k_2_6: float = integral_gain(OF_X_INTEGRAL, "left", "rad/m/s", "x")
    k_2_7: float = integral_gain(-OF_PSI_INTEGRAL, "left", "1/s", "psi")

    @property
    def integral_matrix(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the gains of the integrals, shape (2, 2)."""
        return (self.k_1_6, self.k_1_7), (self.k_2_6, self.k_2_7)


def integral_settings() -> IntegralSettings:
    """Return the settings of the LQR with integrals."""
    return IntegralSettings(**mirrored(WITH_INTEGRAL))


def conflicts(p: Any) -> list[tuple[tuple[str, ...], str]]:
    """Return the parameters that prevent a predictive solution, with reasons."""
    found: list[tuple[tuple[str, ...], str]] = []
    if not p.duty_min < p.duty_nominal < p.duty_max:
        low = not p.duty_min < p.duty_nominal
        said = (
            f"no duty of {p.duty_min:g} to {p.duty_max:g} % holds the craft, which hovers at {p.duty_nominal:.6g} %:"
            " the predictive law has no solution; widen the limits about it"
        )
        found.append((("duty_min" if low else "duty_max", "duty_nominal"), said))
    for names, why in (
        (("weight_tilt", "weight_duty"), "so that there is one best command"),
        (("weight_x", "weight_y", "weight_psi"), "so that no position is left to itself"),
    ):
        found += [((n,), f"{n} is {getattr(p, n):g}; it is above 0, {why}") for n in names if not getattr(p, n) > 0]
    if not p.prediction_step <= p.horizon <= 1000 * p.prediction_step:
        said = f"the horizon of {p.horizon:g} s has 1 to 1000 steps of prediction_step, {p.prediction_step:g} s"
        found.append((("horizon", "prediction_step"), said))
    if not p.tilt_max > 0:
        found.append((("tilt_max",), "tilt_max is above 0; with 0 nothing can be commanded"))
    return found


@dataclass(frozen=True, kw_only=True)
class FullSettings(Settings):
    """Parameters with roll and motors, for the fourteen states linearized at hover."""

    ixx: float = parameter(0.009377, unit="kg.m2", bounds=(2e-3, 1), doc="design model: roll inertia, eq 5.4")
    ground_gain: float = parameter(
        1.1420239, unit="1", bounds=(1, 10), doc="design model: gain of the ground effect at hover, eq 4.28"
    )
    thrust_per_duty: float = parameter(
        3.530619, unit="N/%", bounds=(0.01, 100), doc="design model: slope of the thrust line, eq 4.20"
    )
    roll_stiffness: float = parameter(
        5.4174681,
        unit="N.m/rad",
        bounds=(-1e3, 1e4),
        doc="design model: roll moment per roll, table and ground effect",
    )
    roll_damping: float = parameter(
        0.45, unit="N.m.s/rad", bounds=(0, 10), doc="design model: roll moment per roll rate"
    )


@dataclass(frozen=True, kw_only=True)
class PredictionSettings(Settings):
    """Parameters of predictive laws: weights, limits, horizon. The gains `k_i_j` are unused."""

    weight_x: float = weight(1.0, "1/m2", "x")
    weight_vx: float = weight(0.5, "s2/m2", "vx")
    weight_psi: float = weight(0.1, "1/rad2", "psi")
    weight_psi_dot: float = weight(0.01, "s2/rad2", "psi_dot")
    weight_y: float = weight(1.0, "1/m2", "y")
    weight_vy: float = weight(0.5, "s2/m2", "vy")
    weight_tilt: float = weight(1.0, "1/rad2", "each tilt")
    weight_duty: float = weight(1.0, "1/%2", "the duty of each motor, from the nominal one")
    duty_min: float = parameter(6.0, unit="%", bounds=(0, 100), doc="least duty; eq 4.20 was fitted on 6-7 %")
    duty_max: float = parameter(7.0, unit="%", bounds=(0, 100), doc="greatest duty; eq 4.20 was fitted on 6-7 %")
    speed_max: float = parameter(
        0.0, unit="m/s", bounds=(0, 100), doc="greatest speed forward or back, 0 for none; given up where it must be"
    )
    prediction_step: float = parameter(0.02, unit="s", bounds=(0.01, 1), doc="step of the prediction")
    horizon: float = parameter(2.0, unit="s", bounds=(0.1, 20), doc="how far is predicted; then as the LQR would")
    iterations_max: float = parameter(
        200.0, unit="1", bounds=(1, 1e5), doc="most iterations of the solver a sample; then limits only cut off"
    )

    def __post_init__(self) -> None:
        faults = []
        try:
            super().__post_init__()
        except ValueError as error:
            faults.append(str(error))
        faults += [said for _, said in conflicts(self)]
        if faults:
            raise ValueError("; ".join(faults))


@dataclass(frozen=True, kw_only=True)
class PredictiveSettings(PredictionSettings, FullSettings):
    """Parameters of the predictive law linearized once."""
