"""Modelling language: everything that a user's model file imports.

    from cosim.model import Effect, Equations, Model, Namespace, Quantity, SensorError, parameter

A model needs only Python's standard library, so that its FMU runs in any host with Python.
"""

from cosim.model.delay import Delay, Gain
from cosim.model.integrate import Moment, Stepper
from cosim.model.model import Effect, Equations, Model, Number, Validity, Values, overrides
from cosim.model.namespaces import SCALAR, Namespace
from cosim.model.planar import PlanarFrame, world_velocity
from cosim.model.quantities import Parameter, Quantity, parameter, parameters_of
from cosim.model.sensors import Bias, Drift, Lag, Latency, LeverArm, Scale, SensorError

__all__ = [
    "SCALAR",
    "Bias",
    "Delay",
    "Drift",
    "Effect",
    "Equations",
    "Gain",
    "Lag",
    "Latency",
    "LeverArm",
    "Model",
    "Moment",
    "Namespace",
    "Number",
    "Parameter",
    "PlanarFrame",
    "Quantity",
    "Scale",
    "SensorError",
    "Stepper",
    "Validity",
    "Values",
    "overrides",
    "parameter",
    "parameters_of",
    "world_velocity",
]
