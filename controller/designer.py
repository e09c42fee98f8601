"""`design:` of a scenario, for this controller: gains by LQR, from weights and the numbers of a craft."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from controller.gains import ESTIMATORS, Settings
from plant.design import Option
from plant.hovercraft import Hovercraft
from plant.model import Model
from plant.quantities import parameters_of

GAINS = tuple(f"k_{i}_{j}" for i in (1, 2) for j in range(1, 6))


class LqrDesigner:
    """Gains of eqs 6.2-6.4; the numbers of the design model from a craft, or from what is given."""

    version = 3
    options: Mapping[str, Option] = {
        "Q": Option("weights of the five states, diagonal, eq 6.4", (1.0, 0.5, 0.1, 0.01, 0.0), 5, positive=False),
        "R": Option("weights of the two tilts, diagonal, eq 6.4", (1.0, 1.0), 2),
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

    def values(self, options: Mapping[str, Any], model: Model | None) -> dict[str, float]:
        """Gains, and the craft's numbers where there is one."""
        from controller.synthesis import lqr_gain, numbers_of

        numbers = numbers_of(model) if isinstance(model, Hovercraft) else {}
        K = lqr_gain(replace(Settings(), **{**numbers, **self.given(options)}), options["Q"], options["R"])
        return {name: float(K[divmod(k, 5)]) for k, name in enumerate(GAINS)} | numbers

    def given(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """Estimator, thrust and lag."""
        return {k: v for k in ("thrust_nominal", "lag", "estimator") if (v := options.get(k)) is not None}


DESIGNER = LqrDesigner()
