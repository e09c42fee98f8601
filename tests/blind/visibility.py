"""Visibility of an effect: 2 s replays of a model without the effect, compared with noise-free measurements.

Each replay starts from the true state, so that the missing effect alone makes the error. The noise floor of a channel
is its sensor noise and the error of a perfect model within 2 s under the coloured disturbance.

    python -m tests.blind.visibility        visibility of each outside effect, and its best imitation by the catalogue
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tests.blind.truth import DURATION, VARIANCE, Log, fly
from tests.blind.truth_craft import STEP, Craft, Flight
from tests.blind.truth_outside import OUTSIDE
from tests.blind.truth_study import BASE, EFFECTS, Study, draw, size

HORIZON = 100  # samples in 2 s


def replay_errors(craft: Craft, log: Log) -> dict[str, np.ndarray]:
    """Return channel → replay minus noise-free measurement, for consecutive 2 s replays without the first 2 s."""
    errors: dict[str, list[float]] = {c: [] for c in VARIANCE}
    for k in range(HORIZON, len(log.commands) - HORIZON, HORIZON):
        flight = _at(craft, log, k)
        for j in range(k, k + HORIZON):
            flight.advance(log.commands[j])
            now = flight.outputs()
            for c, values in errors.items():
                values.append(now[c] - log.noiseless[c][j + 1])
    return {c: np.array(v) for c, v in errors.items()}


def _at(craft: Craft, log: Log, k: int) -> Flight:
    """Return the craft at sample `k`: true state, heading of the compass, servos with the commands of the last 2 s."""
    state = log.states[k].copy()
    state[4] = log.noiseless["psi"][k]
    if not state[14:].any():
        state[14:] = (log.states[k, 12:14] - log.states[k - 1, 12:14]) / STEP
    flight = Flight(craft, state, t=log.time[k], tolerance=1e-7)
    for j in range(k - HORIZON, k):
        flight.servos.pieces(log.time[j], log.time[j + 1], log.commands[j])
    return flight


def floor(seed: int = 0) -> dict[str, float]:
    """Return channel → replay error of a perfect model under the coloured disturbance, with sensor noise."""
    quiet = Study(seed, "nothing", {}, True, True, False)
    errors = replay_errors(Craft(), fly(quiet, 0))
    return {c: math.sqrt(np.mean(e**2) + VARIANCE[c]) for c, e in errors.items()}


def visibility(study: Study, levels: dict[str, float], duration: float = DURATION) -> dict[str, float]:
    """Return measured channel → replay error of the base model over the floor, both with noise; 1 is invisible."""
    still = replace(study, disturbed=False)
    log = fly(still, 0, duration=duration)
    errors = replay_errors(Craft(), log)
    return {c: math.sqrt(np.mean(errors[c] ** 2) + levels[c] ** 2) / levels[c] for c in log.channels}


def resemblance(study: Study, levels: dict[str, float], duration: float = DURATION) -> dict[str, float]:
    """Return catalogue effect or base parameter → share of the mean square replay error left at its best size.

    The fit is linear in the size (each parameter scaled, alone and together), in units of the floor, over measured
    channels.
    """
    log = fly(replace(study, disturbed=False), 0, duration=duration)

    def misfit(craft: Craft) -> np.ndarray:
        errors = replay_errors(craft, log)
        return np.concatenate([errors[c] / levels[c] for c in log.channels])

    base = misfit(Craft())
    left = {}
    for name in (*EFFECTS, *BASE):
        values = study.truth.get(name) or size(name, np.random.default_rng(0))
        parts = [values] if len(values) == 1 else [values, *({p: v} for p, v in values.items())]
        crafts = [Craft(base={name: v["value"]}) if name in BASE else Craft(effects={name: v}) for v in parts]
        columns = np.column_stack([misfit(craft) - base for craft in crafts])
        scale = np.linalg.lstsq(columns, -base)[0]
        left[name] = float(np.sum((base + columns @ scale) ** 2) / np.sum(base**2))
    return left


def main() -> None:
    levels = floor()
    first = {name: next(s for s in map(draw, range(1000)) if name in s.truth) for name in OUTSIDE}
    for name, study in first.items():
        seen = max(visibility(study, levels).values())
        mimic, left = min(resemblance(study, levels).items(), key=lambda item: item[1])
        print(f"{name:20} {seen:5.1f} × floor; best mimicked by {mimic}, which leaves {100 * left:.0f} %")


if __name__ == "__main__":
    main()
