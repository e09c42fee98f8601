"""`python -m benchmarks.fmpy_sweep FMU RUNS STEPS STEP`: a parameter study of two coupled FMUs in FMPy.

As in FMPy's example `parameter_variation.py`: unpacked and instantiated once, reset before each run.
"""

from __future__ import annotations

import os
import sys
import tempfile

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from numpy.typing import NDArray

INPUTS, OUTPUTS, RATE = list(range(5)), list(range(5, 10)), [10]


def study(path: str, runs: int, steps: int, h: float) -> NDArray[np.float64]:
    """Return the outputs of both FMUs by run and step; the rate of the first is varied."""
    description = read_model_description(path)
    name = description.coSimulation.modelIdentifier
    folders = [extract(path, tempfile.mkdtemp(dir=os.getcwd())) for _ in range(2)]
    a, b = (FMU2Slave(guid=description.guid, modelIdentifier=name, unzipDirectory=folder) for folder in folders)
    a.instantiate(), b.instantiate()
    table = np.zeros((runs, steps + 1, 10))
    for run, rate in enumerate(np.random.default_rng(0).uniform(1.0, 2.0, runs)):
        for fmu in (a, b):
            fmu.reset()
            fmu.setupExperiment(startTime=0.0)
            fmu.enterInitializationMode()
        a.setReal(RATE, [rate])
        a.exitInitializationMode(), b.exitInitializationMode()
        of_a, of_b = a.getReal(OUTPUTS), b.getReal(OUTPUTS)
        table[run, 0] = *of_a, *of_b
        for k in range(steps):
            a.setReal(INPUTS, of_b)
            b.setReal(INPUTS, of_a)
            a.doStep(k * h, h)
            b.doStep(k * h, h)
            of_a, of_b = a.getReal(OUTPUTS), b.getReal(OUTPUTS)
            table[run, k + 1] = *of_a, *of_b
    return table


if __name__ == "__main__":
    study(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
