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
LQR, PLACED, INTEGRAL, PREDICTIVE, TIME_VARIANT = get_args(Controller)
Place = tuple[str | int, ...]
SETTINGS: Mapping[str, type[Settings]] = {
    LQR: Settings,
    PLACED: Settings,
    INTEGRAL: IntegralSettings,
    PREDICTIVE: PredictiveSettings,
    TIME_VARIANT: TimeVariantSettings,
}
# option, its place in a list → start value; a predictive law has no fifth state
UNCHANGED: dict[Place, str] = {("thrust_nominal",): "thrust_nominal", ("lag",): "lag"}
OF_PREDICTION: dict[Place, str] = {
    ("horizon",): "horizon",
    ("speed_max",): "speed_max",
    **{("Q", k): f"weight_{state}" for k, state in enumerate(("x", "vx", "psi", "psi_dot"))},
    **{("Q_lateral", k): f"weight_{state}" for k, state in enumerate(("y", "vy"))},
    ("R", 0): "weight_tilt",
    **{("duty_limits", k): f"duty_{end}" for k, end in enumerate(("min", "max"))},
    ("R_duty",): "weight_duty",
}
WEIGHTS = {"Q": [*Q_THESIS], "R": [*R_THESIS], "Q_integral": [*Q_INTEGRAL]}
POLES_OF = {"forward": (0, 1, 2), "turning": (3, 4)}  # indices of the five poles
Objections = list[tuple[Place, str]]  # reasons against a design, or warnings, at the place of an option


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
    duty_limits: smallest and largest duty [%]
    speed_max: largest speed forward or backward [m/s]
    horizon: prediction horizon [s]
    estimator: Kalman filter of the controller
    thrust_nominal: thrust per propeller in ground effect T_N [N], in place of the model's
    lag: lag of the design model [s], in place of the model's
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
    """Design the controllers of a craft.

    For the registered craft, the numbers are those of the controllers' default parameters; for another craft they are
    computed.

    Returns:
        Start values by file of an FMU, and warnings.

    Raises:
        InputError: Every fault of the file, and weights or poles without a stable control loop.
    """
    file = yaml.validate(DesignFile)
    craft = model if isinstance(model, Hovercraft) and model != Hovercraft() else None
    starts: dict[str, dict[str, Any]] = {}
    told: tuple[dict[Fault, None], dict[Fault, None]] = {}, {}
    for name in file.controllers:
        starts[name], *groups = controller_starts(name, file, craft)
        for faults, objections in zip(told, groups, strict=True):
            for place, message in objections:
                at = place if place and place[0] in yaml.root else ()
                faults[yaml.fault(at, f"{place[0]}: {message}" if place else message)] = None
    refuse(told[0])
    return starts, [*map(str, told[1])]


def check_design(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a design for the craft as registered; InputError lists its faults."""
    return [f"warning: {warning}" for warning in design(YamlFile(path), Hovercraft())[1]]


def controller_starts(
    name: Controller, file: DesignFile, craft: Hovercraft | None
) -> tuple[dict[str, Any], Objections, Objections]:
    """Return start values of a controller, objections and warnings.

    Args:
        craft: Source of the numbers of the design model; None takes those of the controller's own parameters.
    """
    kind, options, predicts = SETTINGS[name], file.model_dump(), name in (PREDICTIVE, TIME_VARIANT)
    places = dict[str, Place]()  # start value → option that is used unchanged
    declared, values = {p.name: p.default for p in parameters_of(kind)}, dict[str, Any]()
    if craft is not None:
        values = {n: getattr(craft, n) for n in OF_CRAFT} if predicts else {}
        values |= {n: value for n, value in numbers_of(craft).items() if n in declared}
    for place, start in (UNCHANGED | OF_PREDICTION if predicts else UNCHANGED).items():
        if (value := options[str(place[0])]) is not None:
            places[start], values[start] = place, float(value[place[1]] if place[1:] else value)
    if name != TIME_VARIANT and options["estimator"] is not None:
        values["estimator"] = options["estimator"]
    settings = object.__new__(kind)  # not valid yet
    vars(settings).update(declared | values)
    faults = dict[Place, str]()  # one at each place
    for reason in settings.invalid_values():
        place = next((places[word] for word in re.findall(r"\w+", reason) if word in places), ())
        faults.setdefault(place, reason)
    if name == PLACED:
        faults |= {("poles", k): text for k, text in pole_faults([*map(complex, options["poles"])])}
    if predicts and options["R"][0] != options["R"][1]:
        reason = f"{options['R']} has different weights for the tilts; the predictive law has one weight for both"
        faults["R",] = f"{reason}: give the same number twice"
    if faults or predicts:
        return values, [*faults.items()], []
    try:
        if name == PLACED:
            K = placed_gain(settings, [*map(complex, options["poles"])])
        else:
            K = lqr_gain(settings, options["Q"], options["R"], options["Q_integral"] if name == INTEGRAL else ())
    except ValueError as error:
        return values, [(_place_of("forward", options, name)[:1], str(error))], []
    values |= {f"k_{i + 1}_{j + 1}": float(gain) for (i, j), gain in np.ndenumerate(K)}
    return values, *_judged(values, options, name, K)


def _judged(
    values: Mapping[str, Any], options: Mapping[str, Any], name: str, K: Matrix
) -> tuple[Objections, Objections]:
    """Return objections to designed gains, and warnings: bounds, then stability and damping of the sampled loop."""
    gains = [p for p in parameters_of(IntegralSettings) if p.name.startswith("k_") and p.name in values]
    if large := [p for p in gains if p.fault(values[p.name])]:
        size, limit = max(abs(values[p.name]) for p in large), large[0].bounds[1]
        axis = "turning" if large[0].name[-1] in "347" else "forward"  # columns of K and K_i for ψ
        reason = f"results in a gain of {size:.3g}, above the controller's limit of {limit:g}; design a slower loop"
        return [(_place_of(axis, options, name), reason)], []
    names = {p.name for p in parameters_of(Settings)} | {"estimator"}
    p = Settings(**{n: v for n, v in values.items() if n in names})
    try:
        modes = flown_modes(p, K)
    except np.linalg.LinAlgError:  # The estimator has no steady gain.
        return [], []
    objections, warnings = Objections(), Objections()
    nearer = f"use poles closer to {', '.join(f'{pole:g}' for pole in POLES)}"
    cure = nearer if name == PLACED else "increase the weights of the tilts, or reduce those of the states"
    for mode in worst_modes(modes):
        place, pole = _place_of(mode.axis, options, name), mode.pole
        shown = f"{pole.real:.3g}±{abs(pole.imag):.3g}j" if pole.imag else f"{pole.real:.3g}"
        loop = f"with a lag of {p.lag:g} s and {p.estimator}, the sampled {mode.axis} axis has a pole at {shown} rad/s"
        if mode.grows:
            objections.append((place, f"is unstable: {loop}; {cure}"))
        else:
            warnings.append((place, f"{loop} with the small damping ratio {mode.damping:.2g}; {cure}"))
    return objections, warnings


def _place_of(axis: str, options: Mapping[str, Any], name: str) -> Place:
    """Return the option that determines the speed of an axis: its fastest pole, or changed weights."""
    if name == PLACED:
        return "poles", max(POLES_OF[axis], key=lambda k: abs(complex(options["poles"][k])))
    return (next((key for key, ours in WEIGHTS.items() if options.get(key) not in (None, ours)), "Q"),)
