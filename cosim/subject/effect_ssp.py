"""Refined FMUs as SSPs: the original as it is, and FMUs beside it that change its inputs and its readings.

No compiler is required, and the original is not repackaged. The FMUs of the terms need Python in the host.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from cosim.base.scratch import temporary_folder
from cosim.blocks.description import takes_any_step
from cosim.fmi.fmu_build import Recipe, build
from cosim.fmi.model_description import Description
from cosim.fmi.ports import Port, parameter_port, quantity_port
from cosim.loading.file import LoadedModel
from cosim.model.quantities import Parameter, Quantity
from cosim.model.symbolic.languages import Python
from cosim.probing.fmu_structure import Structure
from cosim.ssp.write import SspConnector, SspFmu, Whole, defined_units, write_ssp
from cosim.terms.fmu_model import FmuModel
from cosim.terms.language import Force, RateTerm
from cosim.terms.term_printing import print_readings, print_terms

ORIGINAL, INPUTS, SENSORS = "original", "input_terms", "sensor_terms"  # components
PRINTED = "cosim.fmi.printed_terms"
SUBSTEPS = 8  # communication steps between rows
TEXT = "<p>Terms that the original FMU lacks. A host couples this FMU with it.</p>"
Connection = tuple[tuple[str, str], tuple[str, str]]


class NotInSsp(ValueError):
    """Error: terms cannot stand beside the original."""


@dataclass(frozen=True)
class EffectSsp:
    """The parts of the SSP of an FMU with claimed terms.

    Attributes:
        loaded: Model of the FMU, with the claimed values of terms, sensor errors and the original.
        structure: Structure of the original.
    """

    loaded: LoadedModel
    structure: Structure
    description: Any

    def write(self, path: Path) -> Path:
        """Write the SSP completely or not at all.

        Raises:
            NotInSsp: A term acts inside the original.
        """
        self.check()
        with temporary_folder("ssp") as folder:
            models = [self._original()]
            models += [self._input_terms(folder)] if self.acting else []
            models += [self._sensor_terms(folder)] if self.errors else []
            ports = [(self.description, port.unit) for model in models for port in model.ports]
            name = f"{self.structure.fmu.stem} with {', '.join(self._names()) or 'its values'}"
            stop = self.step * 1000
            return write_ssp(
                path, Whole(name, "", models, self.connections, defined_units(ports), 0.0, stop, self.step)
            )

    def check(self) -> None:
        """Raise NotInSsp for an original or a term that an SSP cannot express."""
        if self.description.coSimulation is None:
            raise NotInSsp(f"{self.structure.fmu.name} offers no co-simulation, which importers of SSPs run")
        inside = [e.name for e in self.acting if _lacks_port(e)]
        if inside:
            raise NotInSsp(f"{', '.join(inside)} act inside the original, where an FMU beside it has no input")
        shown, hidden = self._shown, [k for k in self._states if k not in self._shown]
        if hidden:
            names = [e.name for e in self.acting if {*_read(e)} - {*shown}]
            states = ", ".join(self.model.base_states[k].name for k in hidden)
            raise NotInSsp(f"{', '.join(names)} need the states {states}, which no output of the original shows")

    # -- what acts ----------------------------------------------------------------------------------

    @property
    def model(self) -> FmuModel:
        """Return the model of the FMU."""
        assert isinstance(self.loaded.model, FmuModel)
        return self.loaded.model

    @property
    def acting(self) -> tuple[Any, ...]:
        """Return the terms at inputs and forces."""
        return tuple(self.model.awake)

    @cached_property
    def errors(self) -> dict[str, float]:
        """Return the parameters of the claimed sensor errors."""
        declared = self.model.sensor_parameters
        return {n: float(v) for n, v in self.loaded.sensors.items() if v != declared[n].neutral}

    @property
    def step(self) -> float:
        """Return the communication step [s]."""
        return self.model.rate / (SUBSTEPS if takes_any_step(self.description) else 1)

    def _names(self) -> list[str]:
        return [*(e.name for e in self.acting), *dict.fromkeys(n.partition(".")[0] for n in self.errors)]

    @property
    def _states(self) -> list[int]:
        """Return the states that terms read, by index."""
        return sorted({k for e in self.acting for k in _read(e)})

    @cached_property
    def _shown(self) -> dict[int, Quantity]:
        """Return state → output that equals it."""
        structure = self.structure
        outputs = {q.name: q for q in structure.outputs}
        if self.structure.way == "co-simulation":
            return dict(enumerate(structure.outputs))
        names = [structure.shown.get(q.name, "") for q in structure.states]
        return {k: outputs[n] for k, n in enumerate(names) if n in outputs}

    # -- components ---------------------------------------------------------------------------------

    @property
    def connections(self) -> list[Connection]:
        """Return the connections between the original and the terms."""
        structure, made = self.structure, list[Connection]()
        if self.acting:
            made += [((INPUTS, _acting(q.name)), (ORIGINAL, q.name)) for q in structure.inputs]
            made += [((ORIGINAL, self._shown[k].name), (INPUTS, self._shown[k].name)) for k in self._states]
        if self.errors:
            made += [((ORIGINAL, q.name), (SENSORS, _true(q.name))) for q in structure.outputs]
        return made

    def _original(self) -> SspFmu:
        """Return the original with its changed values."""
        structure, variables = self.structure, self.model.variables
        ports = [SspConnector(q.name, "input", "Real", q.unit) for q in structure.inputs]
        ports += [SspConnector(q.name, "output", "Real", q.unit) for q in structure.outputs]
        own = {p.name for p in self.model.parameters}
        start = {variables[n]: ("Real", float(v)) for n, v in self.loaded.parameters.items() if n in own}
        return SspFmu(ORIGINAL, self.structure.fmu, ports, start)

    def _input_terms(self, folder: Path) -> SspFmu:
        """Return the FMU that changes the inputs."""
        structure, model = self.structure, self.model
        printed = print_terms(model, [e.name for e in self.acting], Python())
        states, names = [self._shown[k] for k in self._states], [p.name for p in printed.parameters]
        ports = [quantity_port(q, "input") for q in (*structure.inputs, *states)]
        ports += [replace(quantity_port(q, "output"), name=_acting(q.name)) for q in structure.inputs]
        parameters = [self._parameter(p) for p in printed.parameters]
        content = {
            "COMMANDS": len(structure.inputs),
            "MEMORY": printed.memory,
            "DELAY": names.index(printed.delay) if printed.delay else None,
            "STEP": self.step,
        }
        places = {f"x[{k}]": f"x[{j}]" for j, k in enumerate(self._states)}
        source = _renumbered(printed.source, places)
        return self._fmu(folder, ("InputTermsFmu", INPUTS), (ports, parameters), content, source)

    def _sensor_terms(self, folder: Path) -> SspFmu:
        """Return the FMU that changes the readings."""
        outputs, declared = self.structure.outputs, self.model.sensor_parameters
        source, lags, latencies = print_readings(self.model, self.errors)
        ports = [replace(quantity_port(q, "input"), name=_true(q.name)) for q in outputs]
        ports += [quantity_port(q, "output") for q in outputs]
        parameters = [self._parameter(replace(declared[n], name=n)) for n in self.errors]
        content = {"LAGS": lags, "LATENCIES": latencies}
        return self._fmu(folder, ("SensorTermsFmu", SENSORS), (ports, parameters), content, source)

    def _parameter(self, p: Parameter) -> Port:
        value = self.errors.get(p.name, self.loaded.parameters.get(p.name, float(p.default)))
        return parameter_port(p, float(value))

    def _fmu(
        self,
        folder: Path,
        names: tuple[str, str],
        variables: tuple[Sequence[Port], Sequence[Port]],
        content: Mapping[str, Any],
        source: str,
    ) -> SspFmu:
        """Return a component of terms, its FMU built in `folder`.

        Args:
            names: Class of the slave, and name of the component.
            variables: Signals and parameters.
            content: Constants of the printed module.
        """
        kind, component = names
        ports = (*variables[0], *variables[1])
        rows = [(p.name, p.causality, float(p.start), p.unit, p.doc, p.bounds) for p in ports]
        constants = "\n".join(f"{name} = {value!r}" for name, value in {"PORTS": rows, **content}.items())
        text = f'"""Terms, printed from their equations."""\n\nimport math\n\ninf = math.inf\n{constants}\n\n\n{source}'
        inputs, outputs = ([p.name for p in ports if p.causality == c] for c in ("input", "output"))
        depends = dict.fromkeys(outputs, inputs)
        about = Description(f"Terms beside {self.structure.fmu.stem}", ports, depends, depends, self.step, 10.0, True)
        recipe = Recipe(("cosim.fmi.terms_fmu", kind), (), about, TEXT, printed=((PRINTED, text),))
        fmu = build(recipe, folder / f"{component}.fmu")
        connectors = [SspConnector(p.name, p.causality, "Real", p.unit) for p in variables[0]]
        return SspFmu(component, fmu, connectors, {p.name: ("Real", float(p.start)) for p in variables[1]})


def _acting(name: str) -> str:
    """Return the name of a changed input."""
    return f"{name}_acting"


def _true(name: str) -> str:
    """Return the name of an output before the errors of its sensor."""
    return f"{name}_true"


def _renumbered(source: str, places: Mapping[str, str]) -> str:
    """Return printed functions with the states that are present only."""
    for old, new in places.items():
        source = source.replace(old, new)
    return source


def _read(term: Any) -> tuple[int, ...]:
    """Return the states on which a term depends, by index."""
    if isinstance(term, Force):
        return term.place.position, term.place.state
    return (term.place.state,) if isinstance(term, RateTerm) else ()


def _lacks_port(term: Any) -> bool:
    """Return whether a term acts on a rate and no input of the original can bring it in."""
    return isinstance(term, (Force, RateTerm)) and term.place.input < 0
