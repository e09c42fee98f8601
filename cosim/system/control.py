"""Step size control of a scenario: watched signals, their scales, and checks of the FMUs' capabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.core.text import did_you_mean
from cosim.fmi.annotations import sampled_by
from cosim.fmi.description import takes_any_step
from cosim.scenario.scenario import FixComponent
from cosim.system.wiring import Building, Components, Transfer


@dataclass(frozen=True)
class PowerBond:
    """Two opposite connections whose signals have a power as product: indices of the outputs and of the inputs."""

    effort: tuple[int, int]
    flow: tuple[int, int]
    name: str
    nominal: float


@dataclass(frozen=True)
class Control:
    """Settings for communication steps that are controlled by their error.

    Attributes:
        estimator: Error estimator: halving, residual or energy.
        shortest, longest: Limits of a step [s].
        nominal: Column → nominal value, 1 by default.
        outputs: Indices of the real outputs of all FMUs with controlled steps.
        is_per_second: True if the tolerance is an error per second of simulated time.
        at_rows: Components that step only at rows.
        rolls_back: True if steps can be repeated.
    """

    estimator: str
    tolerance: float
    is_per_second: bool
    shortest: float
    longest: float
    nominal: tuple[float, ...]
    outputs: tuple[int, ...]
    bonds: tuple[PowerBond, ...]
    at_rows: frozenset[str]
    rolls_back: bool


def control_of(building: Building, transfers: Sequence[Transfer]) -> Control | None:
    """Return the step control; None for steps of equal length."""
    scenario, components = building.scenario, building.components
    settings = scenario.control
    if not {scenario.extrapolate, scenario.interpolate} <= {None, "hold"}:
        for name, component in components.items():
            if isinstance(component, EventFmu):
                message = (
                    f"{name} uses event mode, in which inputs are constant during a step; remove extrapolate and "
                    "interpolate, or set event_mode: false"
                )
                building.note(("components", name), message)
    if settings is None:
        return None
    stated = scenario.components
    at_rows = frozenset(
        n for n in components if isinstance(stated[n], FixComponent) or getattr(stated[n], "step", None)
    )
    controlled = {name: c for name, c in components.items() if name not in at_rows}
    blocks = {name: block for name, block in building.blocks.items() if name in controlled}
    for name, block in blocks.items():
        if block.changes_by_events or isinstance(block, EventFmu):
            continue
        if not takes_any_step(block.description) or sampled_by(block.path) is not None:
            message = f"{name} accepts only one step length; set a step for it (components.{name}.step)"
            building.note(("components", name), message)
    obstacle = rollback_obstacle(controlled)
    if settings.estimator == "halving" and obstacle:
        message = f"estimator: halving is not possible: {obstacle}; remove estimator, or set it to residual"
        building.note(("step", "estimator"), message)
    every, ends_of = building.blocks, (column.partition(".") for column in building.columns)
    nominal = [every[name].nominal(variable) if name in every else 1.0 for name, _, variable in ends_of]
    real = ((name, s.name) for name, block in blocks.items() for s in block.outputs if not (s.local or s.is_whole))
    outputs = [building.place[f"{name}.{output}"][1] for name, output in real]
    bonds = []
    for k, bond in enumerate(settings.bonds):
        ends: list[tuple[int, int]] = []  # (index of the output, index of the input) of each bond's connections
        for side, output, other in (("effort", bond.effort, bond.flow), ("flow", bond.flow, bond.effort)):
            owner = other.partition(".")[0]
            found = [t for t in transfers if t.origin == output and t.name.partition(".")[0] == owner]
            if found and (found[0].factor, found[0].offset) == (1.0, 0.0):
                ends.append((found[0].source, found[0].target))
            else:
                origins = {t.origin for t in transfers}
                hint = "" if output in origins else did_you_mean(output, origins)
                message = f'no output "{output}" with a connection to {owner} without conversion of units{hint}'
                building.note(("step", "bonds", k, side), message)
        if len(ends) == 2:
            power = nominal[ends[0][0]] * nominal[ends[1][0]]
            bonds.append(PowerBond(ends[0], ends[1], f"{bond.effort}·{bond.flow}", power))
    estimator = settings.estimator or ("energy" if bonds else "residual" if obstacle else "halving")
    is_per_second = settings.per == "second"
    if is_per_second and estimator != "halving":
        message = f"an error per second needs estimator: halving; {obstacle or f'here it is {estimator}'}; remove per"
        building.note(("step", "per"), message)
    limits = settings.tolerance, is_per_second, settings.min, settings.max
    return Control(estimator, *limits, tuple(nominal), tuple(outputs), tuple(bonds), at_rows, not obstacle)


def rollback_obstacle(components: Components) -> str:
    """Return the reason why components cannot repeat a step; "" if they can."""
    for name, component in components.items():
        if isinstance(component, EventFmu):
            return f"{name} may end steps early, at its events"
        if isinstance(component, FmuBlock) and not component.rolls_back:
            return f"{name} cannot save its state, or accepts only one step length"
        if not isinstance(component, FmuBlock | SourceBlock):
            return f"{name} cannot restore an earlier state"
    return ""
