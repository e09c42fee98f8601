"""Design of the craft's controllers for `design:` of a scenario, from options and craft parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from controller.gains import ESTIMATORS, GAINS, Settings
from controller.placement import POLES as PLACED
from controller.variants import (
    INTEGRAL,
    INTEGRALS,
    POLES,
    PREDICTIONS,
    PREDICTIVE,
    TIME_VARIANT,
    PredictiveSettings,
    conflicts,
)
from cosim.model import Model, parameters_of
from cosim.model.design import Judged, Objection, Option
from plant.hovercraft import Hovercraft

LISTS = {  # option → start values of a predictive law, which has no fifth state
    "Q": ("weight_x", "weight_vx", "weight_psi", "weight_psi_dot"),
    "Q_lateral": ("weight_y", "weight_vy"),
    "R": ("weight_tilt",),
    "duty_limits": ("duty_min", "duty_max"),
}
DESIGN_NUMBERS = ("mass", "izz", "arm", "friction", "lag", "thrust_nominal", "yaw_damping")  # for `design_model`
BY_WEIGHTS = ("", INTEGRAL, *PREDICTIONS)
Place = tuple[str | int, ...]


class LqrDesigner:
    """Design of gains by eqs 6.2-6.4, or for another law, with parameters of a craft or given values.

    Q and R have the same meaning in all laws with weights, so that a scenario changes its controller in one line.
    """

    version = 6
    options: Mapping[str, Option] = {
        "Q": Option(
            "weights of the five states, diagonal, eq 6.4",
            (1.0, 0.5, 0.1, 0.01, 0.0),
            5,
            positive=False,
            laws=BY_WEIGHTS,
        ),
        "R": Option("weights of the two tilts, diagonal, eq 6.4", (1.0, 1.0), 2, laws=BY_WEIGHTS),
        "poles": Option(
            "poles [rad/s]: three of the forward axis, then two of the turn", PLACED, 5, complex=True, laws=(POLES,)
        ),
        "Q_integral": Option("weights of the integrals of x and ψ", (0.3, 0.05), 2, laws=(INTEGRAL,)),
        "Q_lateral": Option("weights of y and its rate", (1.0, 0.5), 2, positive=False, laws=PREDICTIONS),
        "R_duty": Option("weight of the duty of each motor [1/%²]", 1.0, laws=PREDICTIONS),
        "duty_limits": Option("least and greatest duty [%]", (6.0, 7.0), 2, laws=PREDICTIONS),
        "speed_max": Option("greatest speed forward or back [m/s]", laws=PREDICTIONS),
        "horizon": Option("how far is predicted [s]", 2.0, laws=PREDICTIONS),
        "estimator": Option(
            "Kalman filter of the controller", choices=ESTIMATORS, laws=("", POLES, INTEGRAL, PREDICTIVE)
        ),
        "thrust_nominal": Option("thrust per propeller in ground effect T_N [N], over the model's"),
        "lag": Option("lag of the design model [s], over the model's"),
    }

    def depends_on(self, model: Model | None) -> Mapping[str, Any]:
        """Return the craft's parameters with its effects, or the controller's."""
        if model is None:
            return {p.name: getattr(Settings(), p.name) for p in parameters_of(Settings)}
        if not isinstance(model, Hovercraft):
            raise ValueError(f"is a {model.title}; this controller flies the {Hovercraft.title} and nothing else")
        owners = {"": model} | {f"{e.name}.": e for e in model.awake}
        return {
            prefix + p.name: getattr(owner, p.name) for prefix, owner in owners.items() for p in parameters_of(owner)
        }

    def values(self, options: Mapping[str, Any], model: Model | None, law: str = "") -> dict[str, float]:
        """Return the start values of the law, with the craft's parameters."""
        from controller.synthesis import numbers_of

        numbers = numbers_of(model) if isinstance(model, Hovercraft) else {}
        if law in PREDICTIONS:
            return self._predictive(options, model, numbers, law)
        settings = replace(Settings(), **{**numbers, **self.collect_start_values(options, law)})
        return self._gains(options, settings, law) | numbers

    def objections(self, options: Mapping[str, Any], law: str) -> list[Objection]:
        """Return messages on design options out of bounds, impossible poles, and unequal weights of the two tilts."""
        from controller.placement import pole_faults

        declared = {p.name: p for p in parameters_of(_settings(law))}
        objections = []
        for name, (about, value) in _values_of(options, law).items():
            low, high = declared[name].bounds
            if not low <= value <= high:
                unit = f" {declared[name].unit}".rstrip()
                objections.append(
                    Objection(about, f"{value:g} lies outside [{low:g}, {high:g}]{unit}; take a value inside")
                )
        if law == POLES:
            poles = [complex(pole) for pole in options["poles"]]
            objections += [Objection(("poles", k), message) for k, message in pole_faults(poles)]
        if law in PREDICTIONS and options["R"][0] != options["R"][1]:
            objections.append(
                Objection(
                    ("R",),
                    (
                        f"{options['R']} weighs one tilt more; the predictive law takes one weight for both: write the "
                        "same number twice"
                    ),
                )
            )
        return objections

    def _gains(self, options: Mapping[str, Any], settings: Settings, law: str) -> dict[str, float]:
        """Return the designed gains by parameter name: feedback gains, and integral gains if the law has any."""
        from controller.judging import designed_gains

        K, K_i = designed_gains(options, settings, law)
        gains = {name: float(K[divmod(k, 5)]) for k, name in enumerate(GAINS)}
        return gains | ({} if K_i is None else {name: float(K_i[divmod(k, 2)]) for k, name in enumerate(INTEGRALS)})

    def _predictive(
        self, options: Mapping[str, Any], model: Model | None, numbers: Mapping[str, float], law: str
    ) -> dict[str, float]:
        """Return the weights and limits of a predictive law, and the craft parameters that its prediction needs."""
        values = {**numbers, **{name: float(value) for name, (_, value) in _values_of(options, law).items()}}
        if isinstance(model, Hovercraft) and law == TIME_VARIANT:
            from controller.time_variant_settings import OF_CRAFT

            values |= {name: getattr(model, name) for name in OF_CRAFT if name not in values}
        elif isinstance(model, Hovercraft):
            from controller.synthesis import roll_numbers_of

            values |= roll_numbers_of(model)
        return values

    def judged(self, values: Mapping[str, Any], own: Mapping[str, Any], options: Mapping[str, Any], law: str) -> Judged:
        """Return reasons against a solution of the predictive law, or unstable gains."""
        own = {name: v for name, v in own.items() if name == "estimator" or not isinstance(v, str)}  # without units
        if law in PREDICTIONS:
            settings = SimpleNamespace(**{p.name: p.default for p in parameters_of(_settings(law))} | {**values, **own})
            faults = conflicts(settings)
            if law == TIME_VARIANT:
                from controller.time_variant_settings import craft_faults

                faults += craft_faults(settings)
            places = {name: place for name, (place, _) in _values_of(options, law).items()}
            objections = []
            for names, reason in faults:
                place = next((places[name] for name in names if name in places), ())
                objections.append(Objection(place, f"the settings are not possible together: {reason}", names))
            return Judged(objections)
        from controller.judging import judged_gains

        return judged_gains(values, own, options, law)

    def collect_start_values(self, options: Mapping[str, Any], law: str) -> dict[str, Any]:
        """Return estimator, thrust and lag; the estimator only for laws with a choice."""
        names = ("thrust_nominal", "lag", *(["estimator"] if law in self.options["estimator"].laws else []))
        return {k: v for k in names if (v := options.get(k)) is not None}

    def rests_on(self, designed: Mapping[str, Any], law: str) -> Mapping[str, float]:
        """Return the parameters of eqs 5.33/5.34.

        A predictive law is designed at its start with its own parameters.
        """
        defaults = {} if law in PREDICTIONS else {name: getattr(Settings(), name) for name in DESIGN_NUMBERS}
        return {**defaults, **{n: v for n, v in designed.items() if n in DESIGN_NUMBERS}}


def _settings(law: str) -> Any:
    """Return the settings class of a predictive law."""
    if law == TIME_VARIANT:
        from controller.time_variant_settings import TimeVariantSettings

        return TimeVariantSettings

    return PredictiveSettings


def _values_of(options: Mapping[str, Any], law: str) -> dict[str, tuple[Place, float]]:
    """Return start value → option place and number, for options used unchanged."""

    def same(*names: str) -> dict[str, tuple[Place, float]]:
        """Return options with the name of their start value."""
        return {name: ((name,), options[name]) for name in names if options.get(name) is not None}

    values = same("thrust_nominal", "lag")
    if law not in PREDICTIONS:
        return values
    for option, names in LISTS.items():
        values |= {name: ((option, k), options[option][k]) for k, name in enumerate(names)}
    return {**values, "weight_duty": (("R_duty",), options["R_duty"]), **same("horizon", "speed_max")}


DESIGNER = LqrDesigner()
