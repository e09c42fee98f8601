"""Plant as an FMI slave, with Python's standard library and pythonfmu's own module only."""

from __future__ import annotations

from cosim.fmi.model_fmu import ModelSlave
from cosim.fmi.ports import model_ports
from plant.hovercraft import Hovercraft


class HovercraftPlant(ModelSlave):
    """The hovercraft with its whole catalogue of effects, dormant."""

    model = Hovercraft()
    ports = model_ports(model)
