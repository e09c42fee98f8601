"""Start values of the craft's controllers from a design file: the work of `cosim build --design`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from controller.gains import GAINS, Settings
from controller.judging import Objection, designed_gains, judged_gains
from controller.placement import POLES as PLACED
from controller.placement import pole_faults
from controller.synthesis import Q_INTEGRAL, Q_THESIS, R_THESIS, numbers_of, roll_numbers_of
from controller.time_variant_settings import OF_CRAFT, TimeVariantSettings, craft_faults
from controller.variants import (
    INTEGRAL,
    INTEGRALS,
    POLES,
    PREDICTIONS,
    PREDICTIVE,
    TIME_VARIANT,
    IntegralSettings,
    PredictiveSettings,
    conflicts,
)
from cosim.base.errors import Fault, refuse
from cosim.model import Model, parameters_of
from cosim.storage.artefact import Checking
from cosim.storage.yaml_file import InUnit, NotNegative, Part, Positive, PositiveSeconds, YamlFile
from plant.hovercraft import Hovercraft

Controller = Literal[
    "controller.fmu", "controller-pole.fmu", "controller-lqi.fmu", "controller-mpc.fmu", "controller-ltv-mpc.fmu"
]
LAWS: Mapping[Controller, tuple[str, type[Settings]]] = {  # law and parameters
    "controller.fmu": ("", Settings),
    "controller-pole.fmu": (POLES, Settings),
    "controller-lqi.fmu": (INTEGRAL, IntegralSettings),
    "controller-mpc.fmu": (PREDICTIVE, PredictiveSettings),
    "controller-ltv-mpc.fmu": (TIME_VARIANT, TimeVariantSettings),
}
LISTS = {  # key → start values of a predictive law, which has no fifth state
    "Q": ("weight_x", "weight_vx", "weight_psi", "weight_psi_dot"),
    "Q_lateral": ("weight_y", "weight_vy"),
    "R": ("weight_tilt",),
    "duty_limits": ("duty_min", "duty_max"),
}
Place = tuple[str | int, ...]


def _complex(value: Any) -> Any:
    """Return a number, or a complex number as text; raise ValueError for other values."""
    try:
        number = complex(value.replace(" ", "").replace("i", "j") if isinstance(value, str) else value)
    except (TypeError, ValueError):
        number = complex("nan")
    if isinstance(value, bool) or not (math.isfinite(number.real) and math.isfinite(number.imag)):
        raise ValueError(f"{value!r} is not a number; write a complex pole like -4+1j")
    return str(number).strip("()") if number.imag else number.real


Complex = Annotated[Any, AfterValidator(_complex)]


class DesignFile(Part):
    """Weights and numbers of a design; each law takes its own keys.

    controllers: FMUs that get designed start values
    Q: weights of the five states, diagonal, eq 6.4
    R: weights of the two tilts, diagonal, eq 6.4
    poles: poles [rad/s]: three of the forward axis, then two of the turn
    Q_integral: weights of the integrals of x and ψ
    Q_lateral: weights of y and its rate
    R_duty: weight of the duty of each motor [1/%²]
    duty_limits: least and greatest duty [%]
    speed_max: greatest speed forward or back [m/s]
    horizon: how far is predicted [s]
    estimator: Kalman filter of the controller
    thrust_nominal: thrust per propeller in ground effect T_N [N], in place of the model's
    lag: lag of the design model [s], in place of the model's
    """

    controllers: list[Controller] = Field(["controller.fmu"], min_length=1)
    Q: list[NotNegative] = Field([*Q_THESIS], min_length=5, max_length=5)
    R: list[Positive] = Field([*R_THESIS], min_length=2, max_length=2)
    poles: list[Complex] = Field([*PLACED], min_length=5, max_length=5)
    Q_integral: list[Positive] = Field([*Q_INTEGRAL], min_length=2, max_length=2)
    Q_lateral: list[NotNegative] = Field([1.0, 0.5], min_length=2, max_length=2)
    R_duty: Positive = 1.0
    duty_limits: list[Positive] = Field([6.0, 7.0], min_length=2, max_length=2)
    speed_max: Positive | None = None
    horizon: PositiveSeconds = 2.0
    estimator: Literal["appendix_f", "lagged", "consistent"] | None = None
    thrust_nominal: Annotated[Positive, InUnit("N")] | None = None
    lag: PositiveSeconds | None = None


def design(yaml: YamlFile, model: Model) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Design the controllers of a craft.

    The craft as registered has the numbers of the controllers' own parameters; those of another are computed from it.

    Returns:
        Start values by file of an FMU, and warnings.

    Raises:
        InputError: Every fault of the file, and weights or poles without a stable control loop.
    """
    file = yaml.validate(DesignFile)
    craft = model if isinstance(model, Hovercraft) and model != Hovercraft() else None
    starts: dict[str, dict[str, Any]] = {}
    faults: list[Fault] = []
    warnings: list[Fault] = []

    def fault(objection: Objection) -> Fault:
        option = next(iter(objection.place), None)
        place = objection.place if option in yaml.root else ()
        return yaml.fault(place, objection.message if option is None else f"{option}: {objection.message}")

    for name in file.controllers:
        try:
            starts[name], objections, remarks = controller_starts(name, file, craft)
        except ValueError as error:
            objections, remarks = [getattr(error, "objection", Objection((), str(error)))], []
        faults += map(fault, objections)
        warnings += map(fault, remarks)
    refuse(dict.fromkeys(faults))
    return starts, [*map(str, dict.fromkeys(warnings))]


def check_design(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a design for the craft as registered; InputError lists its faults."""
    return [f"warning: {warning}" for warning in design(YamlFile(path), Hovercraft())[1]]


def controller_starts(
    name: Controller, file: DesignFile, craft: Hovercraft | None
) -> tuple[dict[str, Any], list[Objection], list[Objection]]:
    """Return start values of a controller, objections and warnings; raise ValueError if there are none.

    Args:
        craft: Source of the numbers of the design model; None takes those of the controller's own parameters.
    """
    (law, kind), options = LAWS[name], file.model_dump()
    placed = _placed_values(options, law)
    values: dict[str, Any] = numbers_of(craft) if craft is not None else {}
    if craft is not None and law == TIME_VARIANT:
        values = {name: getattr(craft, name) for name in OF_CRAFT} | values
    elif craft is not None and law == PREDICTIVE:
        values |= roll_numbers_of(craft)
    values |= {name: float(value) for name, (_, value) in placed.items()}
    if law != TIME_VARIANT and options["estimator"] is not None:
        values["estimator"] = options["estimator"]
    if objections := _refused_options(options, law, kind, placed):
        return values, objections, []
    if law in PREDICTIONS:
        settings = SimpleNamespace(**{p.name: p.default for p in parameters_of(kind)} | values)
        reasons = conflicts(settings) + (craft_faults(settings) if law == TIME_VARIANT else [])
        for names, reason in reasons:
            place: Place = next((placed[name][0] for name in names if name in placed), ())
            objections.append(Objection(place, f"the settings are not possible together: {reason}"))
        if not objections:
            replace(kind(), **values)  # raises ValueError for a number of the craft out of its bounds
        return values, objections, []
    K, K_i = designed_gains(options, replace(Settings(), **values), law)
    values |= {name: float(K[divmod(k, 5)]) for k, name in enumerate(GAINS)}
    if K_i is not None:
        values |= {name: float(K_i[divmod(k, 2)]) for k, name in enumerate(INTEGRALS)}
    return values, *judged_gains(values, options, law)


def _refused_options(
    options: Mapping[str, Any], law: str, kind: type[Settings], placed: Mapping[str, tuple[Place, float]]
) -> list[Objection]:
    """Return objections to options out of bounds, impossible poles, and unequal weights of the two tilts."""
    declared = {p.name: p for p in parameters_of(kind)}
    objections = []
    for name, (place, value) in placed.items():
        low, high = declared[name].bounds
        if not low <= value <= high:
            unit = f" {declared[name].unit}".rstrip()
            reason = f"{value:g} lies outside [{low:g}, {high:g}]{unit}; take a value inside"
            objections.append(Objection(place, reason))
    if law == POLES:
        poles = [complex(pole) for pole in options["poles"]]
        objections += [Objection(("poles", k), message) for k, message in pole_faults(poles)]
    if law in PREDICTIONS and options["R"][0] != options["R"][1]:
        reason = f"{options['R']} weighs one tilt more; the predictive law takes one weight for both"
        objections.append(Objection(("R",), f"{reason}: write the same number twice"))
    return objections


def _placed_values(options: Mapping[str, Any], law: str) -> dict[str, tuple[Place, float]]:
    """Return start value → place in the file and number, for options used unchanged."""
    names = ("thrust_nominal", "lag", *(("horizon", "speed_max") if law in PREDICTIONS else ()))
    values: dict[str, tuple[Place, float]] = {n: ((n,), options[n]) for n in names if options[n] is not None}
    if law in PREDICTIONS:
        for option, starts in LISTS.items():
            values |= {name: ((option, k), options[option][k]) for k, name in enumerate(starts)}
        values["weight_duty"] = (("R_duty",), options["R_duty"])
    return values
