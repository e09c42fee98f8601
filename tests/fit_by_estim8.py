"""Answer of estim8 for `fit_head_to_head`, run in an environment of its own: request as an argument, answer as JSON.

estim8 has no recorded inputs; `DrivenModel` passes them to FMPy, which simulates in estim8 too. Weights are the true
standard deviations of the noise. The method is differential evolution, the first of its documentation.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any, ClassVar

import fmpy
import numpy as np
import pandas as pd
from estim8.datatypes import Experiment, Simulation
from estim8.estimator import Estimator
from estim8.models import FmuModel

GENERATIONS = 200


class DrivenModel(FmuModel):  # type: ignore[misc]  # estim8 is untyped
    """A model of estim8 with recorded inputs: name of a log → its rows."""

    tables: ClassVar[dict[str, Any]] = {}
    log = ""
    runs = 0

    def retrieve_variables(self) -> None:
        """Read parameters and outputs; estim8 takes an output that is a state for a parameter."""
        variables = self._model_description.modelVariables
        self.parameters = {v.name: float(v.start) for v in variables if v.causality == "parameter"}
        self.observables = [v.name for v in variables if v.causality == "output"]

    def simulate(
        self,
        t0: float,
        t_end: float,
        stepsize: float,
        parameters: dict[str, float],
        observe: Any = None,
        **_: Any,
    ) -> Any:
        """Simulate one log."""
        type(self).runs += 1
        self._fmu.reset()
        rows = fmpy.simulate_fmu(
            self._unzip_dir,
            start_time=t0,
            stop_time=t_end,
            output_interval=stepsize,
            output=observe,
            start_values={n: v for n, v in parameters.items() if n in self.parameters},
            input=self.tables[self.log],
            fmi_type="CoSimulation",
            validate=False,
            model_description=self._model_description,
            fmu_instance=self._fmu,
            terminate=False,
        )
        return Simulation({n: np.array(rows[n]) for n in ("time", *observe)})


class DrivenEstimator(Estimator):  # type: ignore[misc]
    """An estimator that tells the model the log of each experiment, which estim8 does not."""

    def objective_for_replicate(self, parameters: Any, data: Any, metric: Any = None) -> Any:
        """Return the loss of one experiment."""
        self.model.log = data.replicate_ID
        return super().objective_for_replicate(parameters=parameters, data=data, metric=metric)


def main(request: dict[str, Any]) -> dict[str, Any]:
    """Return the estimates, the number of simulations and the time [s]."""
    data = {}
    for path in request["logs"]:
        log = pd.read_csv(path).set_index("time")
        measured = log[[*request["sigma"]]]
        errors = pd.DataFrame({n: np.full(len(log), s) for n, s in request["sigma"].items()}, index=log.index)
        data[path] = Experiment(measured, replicate_ID=path, errors=errors)
        table = log[request["inputs"]].reset_index()
        DrivenModel.tables[path] = table.to_records(index=False)
    times = table["time"].to_numpy()
    span = [float(times[0]), float(times[-1]), float(times[1] - times[0])]
    model = DrivenModel(request["fmu"], fmi_type="CoSimulation")
    bounds = {n: list(ends) for n, ends in request["bounds"].items()}
    begin = time.monotonic()
    estimator = DrivenEstimator(model, bounds=bounds, data=data, t=span, metric="WSS")
    values, _ = estimator.estimate(
        method="de", max_iter=GENERATIONS, optimizer_kwargs={"seed": 1, "polish": True, "disp": False}
    )
    seconds = time.monotonic() - begin
    return {"values": {n: float(values[n]) for n in bounds}, "runs": DrivenModel.runs, "seconds": seconds}


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]))))
