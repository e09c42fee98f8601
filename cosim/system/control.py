"""Step control of a scenario: which signals are watched, in which scale, and whether the FMUs allow it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from cosim.blocks.component import Component
from cosim.blocks.description import takes_any_step
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.fmi.sampled import sampled_by
from cosim.scenario.scenario import Bond, FixComponent, Scenario, StepControl
from cosim.scenario.scenario_file import Diagnosis
from cosim.storage.yaml_file import did_you_mean
from cosim.system.wiring import Components, RowLayout, Transfer


@dataclass(frozen=True)
class PowerBond:
    """Two connections in opposite directions whose product is a power: places of both outputs and both inputs."""

    effort: tuple[int, int]
    flow: tuple[int, int]
    name: str
    nominal: float


@dataclass(frozen=True)
class Control:
    """Control of the communication steps of a run.

    Attributes:
        estimator: halving, residual or energy.
        shortest, longest: Limits of a step [s].
        nominal: Column → nominal value, 1 by default.
        outputs: Places of the real outputs of all FMUs that step under control.
        at_rows: Components that step only at rows.
    """

    estimator: str
    tolerance: float
    shortest: float
    longest: float
    nominal: tuple[float, ...] = ()
    outputs: tuple[int, ...] = ()
    bonds: tuple[PowerBond, ...] = ()
    at_rows: frozenset[str] = frozenset()


def control_of(
    scenario: Scenario,
    components: Components,
    layout: RowLayout,
    transfers: Sequence[Transfer],
    diagnosis: Diagnosis,
) -> Control | None:
    """Return the step control, None for equal steps."""
    settings = scenario.control
    if not {scenario.extrapolate, scenario.interpolate} <= {None, "hold"}:
        for name, component in components.items():
            if isinstance(component, EventFmu):
                diagnosis.note(
                    ("components", name),
                    (
                        f"{name} runs in event mode, with which inputs are held during a step; leave extrapolate "
                        "and interpolate out, or set event_mode: false"
                    ),
                )
    if settings is None:
        return None
    stated = {name: scenario.components[name] for name in components}
    at_rows = frozenset(n for n, c in stated.items() if isinstance(c, FixComponent) or getattr(c, "step", None))
    controlled = {name: c for name, c in components.items() if name not in at_rows}
    for name, component in controlled.items():
        if not isinstance(component, FmuBlock) or component.changes_by_events or isinstance(component, EventFmu):
            continue
        if not takes_any_step(component.description) or sampled_by(component.path) is not None:
            diagnosis.note(
                ("components", name),
                (
                    f"{name} takes steps of one length only, so that they cannot be controlled; give it a "
                    f"step of its own (components.{name}.step)"
                ),
            )
    obstacle = next(_obstacles(controlled), "")
    if settings.estimator == "halving" and obstacle:
        diagnosis.note(
            ("step", "estimator"),
            f"estimator: halving is not possible: {obstacle}; leave estimator out, or set residual",
        )
    owned = [(components[name], variable) for name, _, variable in (c.partition(".") for c in layout.columns)]
    nominal = tuple(c.nominal(variable) if isinstance(c, FmuBlock) else 1.0 for c, variable in owned)
    bonds = _bonds(settings, layout, transfers, nominal, diagnosis)
    estimator = settings.estimator or ("energy" if bonds else "residual" if obstacle else "halving")
    outputs = tuple(k for k, column in enumerate(layout.columns) if _is_real_output(column, controlled))
    limits = settings.tolerance, settings.min, settings.max
    return Control(estimator, *limits, nominal, outputs, tuple(bonds), at_rows)


def courses_of(scenario: Scenario, components: Components) -> tuple[int, int]:
    """Return the degrees of extrapolation and interpolation; with event mode, inputs are held."""
    return (0, 0) if any(isinstance(c, EventFmu) for c in components.values()) else scenario.courses


def _obstacles(components: Mapping[str, Component]) -> Iterator[str]:
    """Yield reasons against taking steps back."""
    for name, component in components.items():
        if isinstance(component, EventFmu):
            yield f"steps of {name} end at its events"
        elif isinstance(component, FmuBlock) and not component.instance.rolls_back:
            yield f"{name} saves no state"
        elif not isinstance(component, FmuBlock | SourceBlock):
            yield f"{name} cannot be taken back"


def _is_real_output(column: str, components: Mapping[str, Component]) -> bool:
    """Return whether a column is an FMU's real output."""
    name, _, variable = column.partition(".")
    component = components.get(name)
    if not isinstance(component, FmuBlock):
        return False
    return any(s.name == variable and not (s.local or s.is_whole) for s in component.outputs)


def _bonds(
    settings: StepControl,
    layout: RowLayout,
    transfers: Sequence[Transfer],
    nominal: Sequence[float],
    diagnosis: Diagnosis,
) -> list[PowerBond]:
    """Return the power bonds; note faults."""
    by_source: dict[str, list[Transfer]] = {}
    for transfer in transfers:
        by_source.setdefault(layout.columns[transfer.source] if not transfer.beside[0] else "", []).append(transfer)
    bonds = []
    for k, bond in enumerate(settings.bonds):
        effort, flow = (_ends(bond, side, k, by_source, diagnosis) for side in ("effort", "flow"))
        if effort is not None and flow is not None:
            power = nominal[effort[0]] * nominal[flow[0]]
            bonds.append(PowerBond(effort, flow, f"{bond.effort}·{bond.flow}", power))
    return bonds


def _ends(
    bond: Bond, side: str, k: int, by_source: Mapping[str, Collection[Transfer]], diagnosis: Diagnosis
) -> tuple[int, int] | None:
    """Return both ends of one signal of a bond."""
    output, other = (bond.effort, bond.flow) if side == "effort" else (bond.flow, bond.effort)
    where = ("step", "bonds", k, side)
    if output not in by_source:
        hint = did_you_mean(output, by_source)
        diagnosis.note(where, f'no connected output "{output}"{hint}')
        return None
    owner = other.partition(".")[0]
    for transfer in by_source[output]:
        if transfer.name.partition(".")[0] == owner:
            if (transfer.factor, transfer.offset) != (1.0, 0.0):
                diagnosis.note(
                    where, f"{output} is converted on its way to {transfer.name}; a bond needs one unit on both sides"
                )
                return None
            return transfer.source, transfer.target
    diagnosis.note(where, f"{output} is connected to no input of {owner}, the other side of the bond")
    return None
