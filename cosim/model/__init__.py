"""Modelling language: everything that a user's model file imports.

    from cosim.model import DryFriction, Effect, Equations, Model, Namespace, Quantity, SensorError, parameter

A model needs only Python's standard library, so that its FMU runs in any host with Python.
"""

from cosim.model.effects import (
    Asymmetry,
    Delay,
    DryFriction,
    FirstOrderLag,
    Gain,
    Offset,
    QuadraticDrag,
    ViscousFriction,
)
from cosim.model.integrate import Moment, Stepper
from cosim.model.model import Effect, Equations, LocalEffect, Model, Number, Validity, Values, overrides
from cosim.model.namespaces import SCALAR, Namespace
from cosim.model.planar import PlanarFrame, world_velocity
from cosim.model.quantities import Parameter, Quantity, parameter, parameters_of, size
from cosim.model.sensors import Bias, Drift, Lag, Latency, LeverArm, Scale, SensorError

__all__ = [
    "SCALAR",
    "Asymmetry",
    "Bias",
    "Delay",
    "Drift",
    "DryFriction",
    "Effect",
    "Equations",
    "FirstOrderLag",
    "Gain",
    "Lag",
    "Latency",
    "LeverArm",
    "LocalEffect",
    "Model",
    "Moment",
    "Namespace",
    "Number",
    "Offset",
    "Parameter",
    "PlanarFrame",
    "QuadraticDrag",
    "Quantity",
    "Scale",
    "SensorError",
    "Stepper",
    "Validity",
    "Values",
    "ViscousFriction",
    "overrides",
    "parameter",
    "parameters_of",
    "size",
    "world_velocity",
]
