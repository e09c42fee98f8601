"""`design:` of a scenario, for the craft's controllers: what a law needs, from options and the numbers of a craft."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from controller.gains import ESTIMATORS, GAINS, Settings
from controller.placement import POLES as PLACED
from controller.variants import INTEGRAL, POLES, PREDICTIVE, PredictiveSettings, conflicts
from plant.design import BadOption, Option
from plant.hovercraft import Hovercraft
from plant.model import Model
from plant.quantities import parameters_of

INTEGRALS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in (6, 7))
WEIGHTS = (
    "weight_x",
    "weight_vx",
    "weight_psi",
    "weight_psi_dot",
)  # the fifth state has no place in the predictive law
BY_WEIGHTS = ("", INTEGRAL, PREDICTIVE)


class LqrDesigner:
    """Gains of eqs 6.2-6.4, or of another law; the numbers of the design model from a craft, or from what is given.

    Q and R mean the same to every law that has weights, so that a scenario may swap its controller by one line.
    """

    version = 4
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
        "Q_lateral": Option("weights of y and its rate", (1.0, 0.5), 2, positive=False, laws=(PREDICTIVE,)),
        "R_duty": Option("weight of the duty of each motor [1/%²]", 1.0, laws=(PREDICTIVE,)),
        "duty_limits": Option("least and greatest duty [%]", (6.0, 7.0), 2, laws=(PREDICTIVE,)),
        "speed_max": Option("greatest speed forward or back [m/s]", laws=(PREDICTIVE,)),
        "horizon": Option("how far is predicted [s]", 2.0, laws=(PREDICTIVE,)),
        "estimator": Option("Kalman filter of the controller", choices=ESTIMATORS),
        "thrust_nominal": Option("thrust per propeller in ground effect T_N [N], over the model's"),
        "lag": Option("lag of the design model [s], over the model's"),
    }

    def depends_on(self, model: Model | None) -> Mapping[str, Any]:
        """The craft's numbers, its effects' too; or the controller's."""
        if model is None:
            return {p.name: getattr(Settings(), p.name) for p in parameters_of(Settings)}
        if not isinstance(model, Hovercraft):
            raise ValueError(f"is a {model.title}; this controller flies the {Hovercraft.title} and nothing else")
        owners = {"": model} | {f"{e.name}.": e for e in model.awake}
        return {
            prefix + p.name: getattr(owner, p.name) for prefix, owner in owners.items() for p in parameters_of(owner)
        }

    def values(self, options: Mapping[str, Any], model: Model | None, law: str = "") -> dict[str, float]:
        """What the law needs, and the craft's numbers where there is one."""
        from controller.synthesis import numbers_of

        numbers = numbers_of(model) if isinstance(model, Hovercraft) else {}
        settings = replace(Settings(), **{**numbers, **self.given(options)})
        if law == PREDICTIVE:
            return self._predictive(options, model, numbers)
        return self._gains(options, settings, law) | numbers

    def _gains(self, options: Mapping[str, Any], settings: Settings, law: str) -> dict[str, float]:
        """Of laws that are gains."""
        from controller.placement import placed_gain
        from controller.synthesis import integral_gain, lqr_gain

        more: dict[str, float] = {}
        if law == POLES:
            try:
                K = placed_gain(settings, [complex(pole) for pole in options["poles"]])
            except ValueError as error:
                raise BadOption("poles", str(error)) from None
        elif law == INTEGRAL:
            K, K_i = integral_gain(settings, options["Q"], options["R"], options["Q_integral"])
            more = {name: float(K_i[divmod(k, 2)]) for k, name in enumerate(INTEGRALS)}
        else:
            K = lqr_gain(settings, options["Q"], options["R"])
        return {name: float(K[divmod(k, 5)]) for k, name in enumerate(GAINS)} | more

    def _predictive(
        self, options: Mapping[str, Any], model: Model | None, numbers: Mapping[str, float]
    ) -> dict[str, float]:
        """Of the predictive law: weights and limits, and more numbers of the craft."""
        from controller.synthesis import roll_numbers_of

        if options["R"][0] != options["R"][1]:
            raise BadOption("R", f"{options['R']} weighs one tilt more; the predictive law takes one weight for both")
        values = {name: float(q) for name, q in zip(WEIGHTS, options["Q"], strict=False)}
        values["weight_y"], values["weight_vy"] = map(float, options["Q_lateral"])
        values["weight_tilt"], values["weight_duty"] = float(options["R"][0]), float(options["R_duty"])
        values["duty_min"], values["duty_max"] = map(float, options["duty_limits"])
        values["horizon"] = float(options["horizon"])
        if options["speed_max"] is not None:
            values["speed_max"] = float(options["speed_max"])
        values |= numbers
        if isinstance(model, Hovercraft):
            values |= roll_numbers_of(model)
        return values

    def conflicts(self, values: Mapping[str, Any], law: str) -> list[str]:
        """Why the predictive law would have no solution; the others take any values."""
        if law != PREDICTIVE:
            return []
        numbers = {p.name: p.default for p in parameters_of(PredictiveSettings)}
        return conflicts(SimpleNamespace(**{**numbers, **values}))

    def given(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """Estimator, thrust and lag."""
        return {k: v for k in ("thrust_nominal", "lag", "estimator") if (v := options.get(k)) is not None}


DESIGNER = LqrDesigner()
