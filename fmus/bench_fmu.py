"""The testing bench as an FMI slave, which needs only Python's standard library and pythonfmu's module."""

from __future__ import annotations

from cosim.fmi.model_fmu import ModelSlave
from cosim.fmi.ports import model_ports
from plant.bench import Bench


class PropellerBench(ModelSlave):
    """One tilting propeller on three load cells."""

    model = Bench()
    ports = model_ports(model)
