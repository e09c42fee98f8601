"""Offline design of gains, and their judgement on the simulated craft."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from controller.design_model import Matrix, ModelNumbers
from controller.gains import GAINS, Settings
from controller.placement import POLES as PLACED
from controller.placement import placed_gain
from controller.stability import FlownLoop, swing_ratio, worst_modes
from controller.synthesis import Q_INTEGRAL, Q_THESIS, R_THESIS, integral_gain, lqr_gain
from controller.variants import INTEGRAL, INTEGRALS, POLES, FullSettings, IntegralSettings
from cosim.model import parameters_of

AXES = {"forward": (0, 1, 2), "turning": (3, 4)}  # indices of the five poles
SLOWER_FIRST = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01, 0.001, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
TURNING = "347"  # columns of K and K_i for ψ
WEIGHTS = {"Q": [*Q_THESIS], "R": [*R_THESIS], "Q_integral": [*Q_INTEGRAL]}
Place = tuple[str | int, ...]


class Objection(NamedTuple):
    """A reason against a design, or a warning of it, with the place of the option."""

    place: Place
    message: str


class Undesigned(ValueError):
    """Error: no controller design exists for these options."""

    def __init__(self, objection: Objection) -> None:
        super().__init__(objection.message)
        self.objection = objection


def designed_gains(options: Mapping[str, Any], p: ModelNumbers, law: str) -> tuple[Matrix, Matrix | None]:
    """Return K (2, 5), and K_i (2, 2) for the law with integrals, else None.

    Raises:
        Undesigned: The options allow no design.
    """
    try:
        if law == POLES:
            return placed_gain(p, [complex(pole) for pole in options["poles"]]), None
        if law == INTEGRAL:
            return integral_gain(p, options["Q"], options["R"], options["Q_integral"])
        return lqr_gain(p, options["Q"], options["R"]), None
    except ValueError as error:
        raise Undesigned(Objection(_place_of("forward", options, law)[:1], error.args[0])) from None


def judged_gains(
    values: Mapping[str, Any], options: Mapping[str, Any], law: str
) -> tuple[list[Objection], list[Objection]]:
    """Return objections to designed gains, and warnings: bounds, then stability and damping of the sampled loop."""
    gains = [p for p in parameters_of(IntegralSettings) if p.name.startswith("k_") and p.name in values]
    if large := [p for p in gains if p.fault(values[p.name])]:
        size, limit = max(abs(values[p.name]) for p in large), large[0].bounds[1]
        axis = "turning" if large[0].name[-1] in TURNING else "forward"
        reason = f"asks for a gain of {size:.3g}, and the controller takes {limit:g} at most; ask for a slower loop"
        return [Objection(_place_of(axis, options, law), reason)], []
    names = {p.name for p in parameters_of(FullSettings)} | {"estimator"}
    p = FullSettings(**{n: v for n, v in values.items() if n in names})
    try:
        loop = FlownLoop(p, p)
    except np.linalg.LinAlgError:  # The estimator has no steady gain.
        return [], []
    K = np.array([values[name] for name in GAINS]).reshape(2, 5)
    K_i = np.array([values[name] for name in INTEGRALS]).reshape(2, 2) if law == INTEGRAL else None
    objections, warnings = [], []
    for mode in worst_modes(loop.modes(K, K_i)):
        place, cure = _place_of(mode.axis, options, law), _cure(loop, p, mode.axis, options, law)
        loop_text = (
            f"with the lag of {p.lag:g} s, a sample of {p.sample_time:g} s and the estimator {p.estimator} the "
            f"{mode.axis} axis has a pole at {_short(mode.pole)} rad/s"
        )
        if mode.grows:
            reason = f"is not stable as it flies, {loop_text}{cure}"
            objections.append(Objection(place, reason))
        else:
            ratio = 100 * swing_ratio(mode.damping)
            reason = f"{loop_text}, hardly damped by {mode.damping:.2g}: a swing keeps {ratio:.0f} % of its size{cure}"
            warnings.append(Objection(place, reason))
    return objections, warnings


def _place_of(axis: str, options: Mapping[str, Any], law: str) -> Place:
    """Return the option that determines an axis' speed: its fastest pole, or changed weights."""
    if law != POLES:
        changed = (name for name, ours in WEIGHTS.items() if options.get(name) not in (None, ours))
        return (next(changed, "Q"),)
    return "poles", max(AXES[axis], key=lambda k: abs(complex(options["poles"][k])))


def _cure(loop: FlownLoop, craft: Settings, axis: str, options: Mapping[str, Any], law: str) -> str:
    """Return the closest options with damped axis, in words."""
    for factor in SLOWER_FIRST:
        other, proposal = _scale_options(options, axis, law, factor)
        try:
            modes = loop.modes(*designed_gains({**options, **other}, craft, law))
        except ValueError:
            continue
        if not any(mode.axis == axis for mode in worst_modes(modes)):
            return proposal
    nearer = f"; take poles nearer to {', '.join(f'{p:g}' for p in PLACED)}"
    return nearer if law == POLES else "; weigh the states less"


def _scale_options(options: Mapping[str, Any], axis: str, law: str, factor: float) -> tuple[dict[str, Any], str]:
    """Return options for a faster or slower axis, and a proposal in words."""
    if law != POLES:
        weights = [_round(r / factor**2).real for r in options["R"]]
        return {"R": weights}, f"; weigh the tilts more, R: [{', '.join(f'{r:.3g}' for r in weights)}] for one"
    poles = [_round(complex(p) * factor) if k in AXES[axis] else complex(p) for k, p in enumerate(options["poles"])]
    numbers = ", ".join(_short(poles[k]) for k in AXES[axis])
    return {"poles": poles}, f"; take {'slower' if factor < 1 else 'faster'} poles there, {numbers} for one"


def _round(number: complex) -> complex:
    """Return the number rounded as displayed."""
    return complex(float(f"{number.real:.3g}"), float(f"{number.imag:.3g}"))


def _short(pole: complex) -> str:
    return f"{pole.real:.3g}±{abs(pole.imag):.3g}j" if pole.imag else f"{pole.real:.3g}"
