"""Start values of the craft's controllers from a design file: the work of `cosim build --design`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, Field

from controller.design_model import Matrix
from controller.settings import (
    OF_CRAFT,
    IntegralSettings,
    PredictiveSettings,
    Settings,
    TimeVariantSettings,
)
from controller.synthesis import (
    POLES,
    Q_INTEGRAL,
    Q_THESIS,
    R_THESIS,
    flown_modes,
    lqr_gain,
    numbers_of,
    placed_gain,
    pole_faults,
    worst_modes,
)
from cosim.core.errors import Fault, refuse
from cosim.files.artefact import Checking
from cosim.files.yaml_file import InUnit, NotNegative, Part, Positive, PositiveSeconds, YamlFile
from cosim.model import Model, parameters_of
from plant.hovercraft import Hovercraft

Controller = Literal[
    "controller.fmu", "controller-pole.fmu", "controller-lqi.fmu", "controller-mpc.fmu", "controller-ltv-mpc.fmu"
]
LQR, PLACED, WITH_INTEGRAL, PREDICTIVE, TIME_VARIANT = get_args(Controller)
Place = tuple[str | int, ...]
SETTINGS: Mapping[str, type[Settings]] = {
    LQR: Settings,
    PLACED: Settings,
    WITH_INTEGRAL: IntegralSettings,
    PREDICTIVE: PredictiveSettings,
    TIME_VARIANT: TimeVariantSettings,
}
# start value → option that it takes unchanged, with the place in a list; a predictive law has no fifth state
UNCHANGED: dict[str, Place] = {"thrust_nominal": ("thrust_nominal",), "lag": ("lag",)}
OF_PREDICTION: dict[str, Place] = UNCHANGED | {
    **{name: (name,) for name in ("horizon", "speed_max")},
    **{f"weight_{state}": ("Q", k) for k, state in enumerate(("x", "vx", "psi", "psi_dot"))},
    **{f"weight_{state}": ("Q_lateral", k) for k, state in enumerate(("y", "vy"))},
    **{f"duty_{end}": ("duty_limits", k) for k, end in enumerate(("min", "max"))},
    "weight_tilt": ("R", 0),
    "weight_duty": ("R_duty",),
}
WEIGHTS = {"Q": [*Q_THESIS], "R": [*R_THESIS], "Q_integral": [*Q_INTEGRAL]}
POLES_OF = {"forward": (0, 1, 2), "turning": (3, 4)}  # indices of the five poles
Objections = dict[Place, str]  # reasons against a design, or warnings, one at the place of an option


def _complex(value: Any) -> Any:
    """Return a real number, or the complex number in a text; raise ValueError for other values."""
    try:
        number = complex(value.replace(" ", "").replace("i", "j") if isinstance(value, str) else value)
    except (TypeError, ValueError, OverflowError):
        number = complex("nan")
    if isinstance(value, bool) or not (math.isfinite(number.real) and math.isfinite(number.imag)):
        raise ValueError(f"{value!r} is not a number; write a complex pole like -4+1j")
    return str(number).strip("()") if number.imag else number.real


Complex = Annotated[Any, AfterValidator(_complex)]


class DesignFile(Part):
    """Weights and numbers of a controller design; each control law uses its own keys.

    controllers: FMUs that get designed start values
    Q: weights of the five states, diagonal, eq 6.4
    R: weights of the two tilts, diagonal, eq 6.4
    poles: poles [rad/s]: three of the forward axis, then two of the turn
    Q_integral: weights of the integrals of x and ψ
    Q_lateral: weights of y and its rate
    R_duty: weight of the duty of each motor [1/%²]
    duty_limits: smallest and largest duty [%]
    speed_max: largest speed forward or backward [m/s]
    horizon: prediction horizon [s]
    estimator: Kalman filter of the controller
    thrust_nominal: thrust per propeller in ground effect T_N [N]; by default that of the model
    lag: lag of the design model [s]; by default that of the model
    """

    controllers: list[Controller] = Field(["controller.fmu"], min_length=1)
    Q: list[NotNegative] = Field([*Q_THESIS], min_length=5, max_length=5)
    R: list[Positive] = Field([*R_THESIS], min_length=2, max_length=2)
    poles: list[Complex] = Field([*POLES], min_length=5, max_length=5)
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
    """Return the designed start values of the controllers of a craft.

    For the registered craft, the numbers are those of the controllers' default parameters; for another craft they are
    computed.

    Returns:
        FMU file name → variable → start value, and warnings.

    Raises:
        InputError: The file has faults, or weights or poles do not give a stable loop; the error names all faults.
    """
    file = yaml.validate(DesignFile)
    craft = model if isinstance(model, Hovercraft) and model != Hovercraft() else None
    starts, told = dict[str, dict[str, Any]](), (dict[Fault, None](), dict[Fault, None]())
    for name in file.controllers:
        starts[name], *groups = controller_starts(name, file, craft)
        for faults, objections in zip(told, groups, strict=True):
            for place, message in objections.items():
                at = place if place and place[0] in yaml.root else ()
                faults[yaml.fault(at, f"{place[0]}: {message}" if place else message)] = None
    refuse(told[0])
    return starts, [*map(str, told[1])]


def check_design(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a design for the registered craft; raise InputError with all faults."""
    return [f"warning: {warning}" for warning in design(YamlFile(path), Hovercraft())[1]]


def controller_starts(
    name: Controller, file: DesignFile, craft: Hovercraft | None
) -> tuple[dict[str, Any], Objections, Objections]:
    """Return start values of a controller, objections and warnings.

    Args:
        craft: Craft for which the design model is computed; None for the default parameters of the controller.
    """
    kind, options, predicts = SETTINGS[name], file.model_dump(), name in (PREDICTIVE, TIME_VARIANT)
    declared, values = {p.name: p.default for p in parameters_of(kind)}, dict[str, Any]()
    if craft is not None:
        values = {n: getattr(craft, n) for n in OF_CRAFT} if predicts else {}
        values |= {n: value for n, value in numbers_of(craft).items() if n in declared}
    places = OF_PREDICTION if predicts else UNCHANGED
    places = {start: place for start, place in places.items() if options[str(place[0])] is not None}
    for start, (option, *number) in places.items():
        values[start] = float(options[str(option)][number[0]] if number else options[str(option)])
    if name != TIME_VARIANT and options["estimator"] is not None:
        values["estimator"] = options["estimator"]
    settings = object.__new__(kind)  # not valid yet
    vars(settings).update(declared | values)
    faults, poles = Objections(), [*map(complex, options["poles"])]
    for reason in settings.invalid_values():
        place = next((places[word] for word in re.findall(r"\w+", reason) if word in places), ())
        faults.setdefault(place, reason)
    if name == PLACED:
        faults |= {("poles", k): text for k, text in pole_faults(poles)}
    if predicts and options["R"][0] != options["R"][1]:
        reason = f"{options['R']} has different weights for the tilts; the predictive law has one weight for both"
        faults["R",] = f"{reason}: give the same number twice"
    if faults or predicts:
        return values, faults, {}
    integral = options["Q_integral"] if name == WITH_INTEGRAL else ()
    try:
        K = placed_gain(settings, poles) if name == PLACED else lqr_gain(settings, options["Q"], options["R"], integral)
    except ValueError as error:
        return values, {_place_of("forward", options, name)[:1]: str(error)}, {}
    values |= {f"k_{i + 1}_{j + 1}": float(gain) for (i, j), gain in np.ndenumerate(K)}
    return values, *_judged(settings, options, name, K)


def _judged(p: Settings, options: Mapping[str, Any], name: str, K: Matrix) -> tuple[Objections, Objections]:
    """Return objections to designed gains, and warnings, by stability and damping of the sampled loop."""
    objections, warnings = Objections(), Objections()
    try:
        modes = flown_modes(p, K)
    except np.linalg.LinAlgError:  # The estimator has no steady gain.
        return objections, warnings
    nearer = f"use poles closer to {', '.join(f'{pole:g}' for pole in POLES)}"
    cure = nearer if name == PLACED else "increase the weights of the tilts, or reduce those of the states"
    for mode in worst_modes(modes):
        place, pole = _place_of(mode.axis, options, name), mode.pole
        shown = f"{pole.real:.3g}±{abs(pole.imag):.3g}j" if pole.imag else f"{pole.real:.3g}"
        about = f"(lag {p.lag:g} s, estimator {p.estimator})"
        loop = f"the sampled loop of the {mode.axis} axis {about} has a pole at {shown} rad/s"
        if mode.grows:
            objections.setdefault(place, f"is unstable: {loop}; {cure}")
        else:
            warnings.setdefault(place, f"{loop}, with a damping ratio of only {mode.damping:.2g}; {cure}")
    return objections, warnings


def _place_of(axis: str, options: Mapping[str, Any], name: str) -> Place:
    """Return the option that determines the speed of an axis: its fastest pole, or changed weights."""
    if name == PLACED:
        return "poles", max(POLES_OF[axis], key=lambda k: abs(complex(options["poles"][k])))
    return (next((key for key, ours in WEIGHTS.items() if options.get(key) not in (None, ours)), "Q"),)
