"""Catalogue of effects missing in the base model, in the order of their action on a command."""

from __future__ import annotations

from plant.effects.actuator import (
    ActuatorDelay,
    ActuatorSecondOrder,
    ServoBacklash,
    ServoDeadBand,
    ServoRateLimit,
    TiltOffset,
)
from plant.effects.body import ComOffset, Coriolis, TableTilt
from plant.effects.friction import CoulombFriction, QuadraticDrag, StribeckFriction, YawCoulombFriction, YawDamping
from plant.effects.thrust import BatterySag, InflowThrustLoss, ThrustAsymmetry

CATALOGUE = (
    ActuatorDelay,
    ServoBacklash,
    TiltOffset,
    ServoDeadBand,
    ActuatorSecondOrder,
    ServoRateLimit,
    ThrustAsymmetry,
    BatterySag,
    InflowThrustLoss,
    CoulombFriction,
    StribeckFriction,
    QuadraticDrag,
    YawDamping,
    YawCoulombFriction,
    ComOffset,
    TableTilt,
    Coriolis,
)
