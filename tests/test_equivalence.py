"""Hypotheses with equal effects for every input: one claim with both names, and no experiment to separate them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cosim.estimation.fit import initial_fit
from cosim.estimation.posing import build_problem
from cosim.estimation.subject.model_subject import ModelSubject
from cosim.logs.log import Log
from cosim.model import Effect, Equations, Model, Namespace, Number, Quantity, Values, parameter
from cosim.refinement.decision.bundle import act_alike
from cosim.refinement.search.fits import Hypothesis, Search


@dataclass(frozen=True, kw_only=True)
class Bypass(Effect):
    """More flow of the inlet, which its parameter is too."""

    name = "bypass"
    equation = "(c + d)·(inlet − cold)"
    more: float = parameter(0.0, unit="W/K", bounds=(0.0, 5.0), neutral=0.0, typical=0.5, doc="d")


@dataclass(frozen=True, kw_only=True)
class Exchanger(Model):
    """A heat exchanger: the same rates for all conductances and the inverse of all heat capacities."""

    base_states = (Quantity("cold", "K", ""), Quantity("hot", "K", ""))
    inputs = (Quantity("inlet", "K", ""),)
    outputs = base_states
    forced = ("cold", "hot")
    catalogue = (Bypass,)
    calibrated = ("UA", "c", "C_c", "C_h")
    substep = 0.1

    UA: float = parameter(2.0, unit="W/K", bounds=(0.1, 20.0), doc="conductance between both sides")
    c: float = parameter(1.0, unit="W/K", bounds=(0.1, 20.0), doc="heat flow of the inlet")
    C_c: float = parameter(3.0, unit="J/K", bounds=(0.1, 30.0), doc="heat capacity of the cold side")
    C_h: float = parameter(5.0, unit="J/K", bounds=(0.1, 30.0), doc="heat capacity of the hot side")

    def equations(self, m: Namespace) -> Equations:
        """Return the balances of both sides."""

        through = self.c + sum(bypass.more for bypass in self.awake)

        def derivative(t: Number, state: Values, command: Values) -> Values:
            flow = self.UA * (state[1] - state[0])
            return (flow + through * (command[0] - state[0])) / self.C_c, -flow / self.C_h

        return Equations(derivative, lambda t, state, command: state)


def alike(search: Search, one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Return whether hypotheses with these values of their parameters, and all others as stated, act alike."""
    given = initial_fit(search.problem)
    candidates = search.subject.candidates([q.name for q in search.subject.inputs])
    hypotheses = []
    for values in (one, other):
        parts = tuple(c for c in candidates if not values.keys().isdisjoint(c.parameters))
        hypotheses.append(Hypothesis(parts, replace(given, values={**given.values, **values}), 0.0))
    return act_alike(search, *hypotheses)


def test_a_parameter_and_an_effect_act_alike_and_sums_where_only_ratios_of_parameters_act(tmp_path: Path) -> None:
    time = 0.5 * np.arange(400)
    inlet = 300.0 + 20.0 * np.sign(np.sin(0.2 * time))
    readings = {n: np.full(time.size, 300.0) for n in ("cold", "hot")}
    log = Log(tmp_path / "log.csv", time, {"inlet": inlet}, readings, {}, 0.5, {}, {})
    subject = ModelSubject.of(Exchanger())
    problem = build_problem(subject, [log], noise={"cold": 0.1, "hot": 0.1})
    search = Search(subject, problem, 30, lambda stage, share: None)
    assert alike(search, {"c": 1.4}, {"bypass.more": 0.3})  # fitted elsewhere
    assert not alike(search, {"c": 1.4}, {"UA": 3.0})
    flows = {"UA": 3.0, "c": 1.5}
    assert alike(search, flows, {"C_c": 2.0, "C_h": 10.0 / 3.0})
    assert alike(search, flows, {"C_c": 2.1, "C_h": 3.2})
    assert not alike(search, flows, {"UA": 3.0, "C_c": 2.0})  # C_h far beyond its tolerance
    assert not alike(search, {"UA": 3.0, "c": 0.7}, {"C_c": 2.1, "C_h": 3.2})
