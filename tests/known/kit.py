"""FMUs of a few equations for FMI 1.0, 2.0 and 3.0, co-simulation and model exchange, from one description.

A library holds all interfaces of a model and is compiled once a session.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import re
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import pytest

from cosim.fmi.native.compiler import compiler

HERE = Path(__file__).parent
Way = Literal["cs", "me"]
C_TYPES = {
    "Float64": ("F64", "double"), "Float32": ("F32", "float"), "Int8": ("I8", "int8_t"), "UInt8": ("U8", "uint8_t"),
    "Int16": ("I16", "int16_t"), "UInt16": ("U16", "uint16_t"), "Int32": ("I32", "int32_t"),
    "UInt32": ("U32", "uint32_t"), "Int64": ("I64", "int64_t"), "UInt64": ("U64", "uint64_t"),
    "Boolean": ("BOOL", "bool"), "Enumeration": ("ENUM", "int64_t"), "String": ("STR", "char"),
    "Binary": ("BIN", "Bytes"),
}  # fmt: skip
FEWER = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean", "String": "String", "Enumeration": "Enumeration"}
RESERVED = ("time", "next", "changed", "more", "end", "ask", "initializing", "memory")  # fields of each model


@dataclass(frozen=True)
class V:
    """A variable.

    Attributes:
        size: Number of elements of an array, 0 for a scalar.
        alias: Name of the variable whose value reference this one has; "-x" for the negated alias of FMI 1.0.
        extra: Further XML attributes, such as a declared type.
    """

    name: str
    causality: str = "output"
    type: str = "Float64"
    start: object = None
    unit: str = ""
    variability: str = ""
    size: int = 0
    alias: str = ""
    extra: str = ""
    readable: bool = True

    @property
    def field(self) -> str:
        return re.sub(r"\W", "_", self.name)

    @property
    def changes(self) -> str:
        """Return the variability, by default that of the type and causality."""
        if self.variability:
            return self.variability
        if self.causality in ("parameter", "calculatedParameter"):
            return "fixed"
        return "continuous" if self.type in ("Float64", "Float32") else "discrete"

    @property
    def text(self) -> str:
        """Return the start value as XML has it."""
        values = self.start if isinstance(self.start, list | tuple) else [self.start]
        return " ".join(str(v).lower() if isinstance(v, bool) else v if isinstance(v, str) else repr(v) for v in values)


def u(name: str = "u", start: object = 0.0, **more: object) -> V:
    """Return an input."""
    return V(name, "input", start=start, **more)  # type: ignore[arg-type]


def p(name: str, start: object, **more: object) -> V:
    """Return a parameter."""
    return V(name, "parameter", start=start, **more)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Model:
    """A model by C expressions and statements, in which variables have their names.

    Attributes:
        rates: State → expression of its derivative.
        calc: Statements that compute outputs from states, inputs and `time`.
        start: Statements at the end of initialization.
        step: Statements at the end of a step of co-simulation, from `t` over `h`.
        zeros: Event indicators.
        event: Statements of an update of discrete states; they set `changed`, `more`, `end` and `next`.
        completed: Statements of a completed step of the integrator; they may set `ask`.
        depends: Output → inputs on which it depends directly; None declares nothing.
        initial: Output → inputs on which it depends in initialization.
        functions: Further C functions.
    """

    name: str
    variables: tuple[V, ...]
    rates: Mapping[str, str] = field(default_factory=dict)
    calc: str = ""
    start: str = ""
    step: str = ""
    zeros: tuple[str, ...] = ()
    event: str = ""
    completed: str = ""
    depends: Mapping[str, tuple[str, ...]] | None = None
    initial: Mapping[str, tuple[str, ...]] | None = None
    units: str = ""
    types: str = ""
    functions: str = ""
    saves: bool = True
    any_step: bool = True

    @property
    def all(self) -> tuple[V, ...]:
        """Return the variables and the derivatives of the states."""
        return (*self.variables, *(V(f"der({x})", "local") for x in self.rates))

    def reference(self, name: str) -> int:
        """Return the value reference of a variable."""
        position = {v.name: k + 1 for k, v in enumerate(self.all)}
        alias = self.all[position[name] - 1].alias.lstrip("-")
        return position[alias or name]

    def c(self) -> str:
        """Return model.c."""
        own = [v for v in self.all if not v.alias]
        fields = sorted((v.field for v in own), key=len, reverse=True)
        pattern = re.compile(rf"(?<![\w.>])({'|'.join([*fields, *RESERVED])})\b")

        def body(statements: str) -> str:
            return pattern.sub(r"m->\1", statements)

        def declare(v: V) -> str:
            size = "[64]" if v.type == "String" else f"[{v.size}]" if v.size else ""
            return f"{C_TYPES[v.type][1]} {v.field}{size};"

        def initialize(v: V) -> str:
            if v.type == "String":
                return f"strcpy(m->{v.field}, {quoteattr(str(v.start))});"
            if v.type == "Binary":
                data = bytes.fromhex(str(v.start))
                puts = "".join(f"m->{v.field}.byte[{k}] = {byte};" for k, byte in enumerate(data))
                return f"m->{v.field}.size = {len(data)}; {puts}"
            values = v.start if isinstance(v.start, list | tuple) else [v.start]
            texts = [f"{value}{'ull' if v.type == 'UInt64' else ''}" for value in map(_c_value, values)]
            if v.size:
                return "".join(f"m->{v.field}[{k}] = {text};" for k, text in enumerate(texts))
            return f"m->{v.field} = {texts[0]};"

        rows = ", ".join(
            f"{{{self.reference(v.name)}, {C_TYPES[v.type][0]}, offsetof(M, {v.field}), {v.size or 1}, "
            f"{int(v.readable)}}}"
            for v in own
        )
        rows += ", {899, F64, offsetof(M, time), 1, 1}"
        states = "".join(f"offsetof(M, {V(x).field}), " for x in self.rates)
        references = "".join(f"{self.reference(x)}, " for x in self.rates)
        derivatives = [(V(f"der({x})").field, body(f"({rate})")) for x, rate in self.rates.items()]
        shown = "".join(f"m->{name} = {rate};" for name, rate in derivatives)
        slopes = "".join(f"d[{k}] = m->{name};" for k, (name, _) in enumerate(derivatives))
        zeros = "".join(f"z[{k}] = {body(zero)};" for k, zero in enumerate(self.zeros))
        return (
            f"{self.functions}\n#define NAME {self.name}\n#define NX {len(self.rates)}\n#define NZ {len(self.zeros)}\n"
            "typedef struct { double time, next, memory[400]; bool changed, more, end, ask, initializing;\n"
            f"{' '.join(map(declare, own))} }} M;\n"
            f"static const Row ROWS[] = {{{rows}}};\n"
            f"static const size_t STATES[] = {{{states}0}}; static const VR STATE_VRS[] = {{{references}0}};\n"
            f"static void defaults(M *m) {{ {' '.join(initialize(v) for v in own if v.start is not None)} }}\n"
            f"static void calc(M *m) {{ {body(self.calc)} {shown} }}\n"
            f"static void rates(M *m, double *d) {{ calc(m); {slopes} }}\n"
            f"static void start(M *m) {{ {body(self.start)} }}\n"
            f"static void step(M *m, double t, double h) {{ {body(self.step)} }}\n"
            f"static void zeros(M *m, double *z) {{ {zeros} }}\n"
            f"static void event(M *m) {{ {body(self.event)} }}\n"
            f"static void completed(M *m) {{ {body(self.completed)} }}\n"
        )

    def description(self, version: int, way: Way) -> str:
        """Return modelDescription.xml."""
        return (self._first, self._second, self._third)[version - 1](way)

    def _first(self, way: Way) -> str:
        causalities = {"input": "input", "output": "output", "parameter": "internal", "local": "internal"}
        changes = {"fixed": "parameter", "tunable": "parameter"}
        scalars = ""
        for v in self.all:
            alias = "" if not v.alias else "negatedAlias" if v.alias[0] == "-" else "alias"
            attributes = _attributes(
                name=v.name, valueReference=self.reference(v.name), causality=causalities[v.causality],
                variability=changes.get(v.changes, v.changes), alias=alias,
            )  # fmt: skip
            real = _attributes(start="" if v.start is None or alias else v.text, unit=v.unit)
            direct = ""
            if v.causality == "output" and self.depends is not None:
                names = "".join(f"<Name>{x}</Name>" for x in self.depends.get(v.name, ()))
                direct = f"<DirectDependency>{names}</DirectDependency>"
            scalars += f"<ScalarVariable {attributes}><{FEWER[v.type]} {real} {v.extra}/>{direct}</ScalarVariable>\n"
        flags = _attributes(canHandleVariableCommunicationStepSize=self.any_step)
        part = f"<CoSimulation_StandAlone><Capabilities {flags}/></CoSimulation_StandAlone>"
        part = f"<Implementation>{part}</Implementation>"
        head = _attributes(
            fmiVersion="1.0", modelName=self.name, modelIdentifier=self.name, guid="g",
            numberOfContinuousStates=len(self.rates), numberOfEventIndicators=len(self.zeros),
        )  # fmt: skip
        units = f"<UnitDefinitions>{self.units}</UnitDefinitions>" if self.units else ""
        types = f"<TypeDefinitions>{self.types}</TypeDefinitions>" if self.types else ""
        return _document(
            head, f"{units}{types}<ModelVariables>\n{scalars}</ModelVariables>{part if way == 'cs' else ''}"
        )

    def _second(self, way: Way) -> str:
        index = {v.name: k + 1 for k, v in enumerate(self.all)}
        scalars = ""
        for v in self.all:
            attributes = _attributes(
                name=v.name, valueReference=self.reference(v.name), causality=v.causality, variability=v.changes,
                initial=self._initial(v),
            )  # fmt: skip
            state = index[v.name[4:-1]] if v.name.startswith("der(") else ""
            real = _attributes(start="" if v.start is None else v.text, unit=v.unit, derivative=state)
            scalars += f"<ScalarVariable {attributes}><{FEWER[v.type]} {real} {v.extra}/></ScalarVariable>\n"

        attributes = 'name="time" valueReference="899" causality="independent" variability="continuous"'
        scalars += f"<ScalarVariable {attributes}><Real/></ScalarVariable>\n"

        def unknown(name: str, depends: Mapping[str, tuple[str, ...]] | None) -> str:
            ends = {} if depends is None else {"dependencies": " ".join(str(index[x]) for x in depends.get(name, ()))}
            return f'<Unknown index="{index[name]}"' + "".join(f' {k}="{x}"' for k, x in ends.items()) + "/>"

        outputs = "".join(unknown(v.name, self.depends) for v in self.all if v.causality == "output")
        slopes = "".join(unknown(f"der({x})", None) for x in self.rates)
        first = "".join(unknown(name, self.initial) for name in self._initial_unknowns())
        structure = "".join(
            f"<{tag}>{content}</{tag}>"
            for tag, content in (("Outputs", outputs), ("Derivatives", slopes), ("InitialUnknowns", first))
            if content
        )
        return self._document(2, way, scalars, structure, 'fmiVersion="2.0" guid="g"')

    def _third(self, way: Way) -> str:
        scalars = ""
        for v in self.all:
            if v.alias:
                continue
            state = self.reference(v.name[4:-1]) if v.name.startswith("der(") else ""
            written = v.start is not None and v.type not in ("String", "Binary")
            attributes = _attributes(
                name=v.name, valueReference=self.reference(v.name), causality=v.causality, variability=v.changes,
                initial=self._initial(v), start=v.text if written else "", unit=v.unit, derivative=state,
            )  # fmt: skip
            inner = f'<Dimension start="{v.size}"/>' if v.size else ""
            if v.start is not None and not written:
                inner += f"<Start value={quoteattr(v.text)}/>"
            inner += "".join(f"<Alias name={quoteattr(a.name)}/>" for a in self.all if a.alias == v.name)
            scalars += f"<{v.type} {attributes} {v.extra}>{inner}</{v.type}>\n"
        scalars += '<Float64 name="time" valueReference="899" causality="independent" variability="continuous"/>\n'
        kinds = {f"zero{k}": 900 + k for k in range(len(self.zeros))}
        scalars += "".join(f'<Float64 name="{z}" valueReference="{k}" causality="local"/>\n' for z, k in kinds.items())

        def unknown(tag: str, name: str, depends: Mapping[str, tuple[str, ...]] | None) -> str:
            text = f'<{tag} valueReference="{self.reference(name)}"'
            if depends is not None:
                text += f' dependencies="{" ".join(str(self.reference(x)) for x in depends.get(name, ()))}"'
            return text + "/>"

        structure = "".join(
            unknown("Output", v.name, self.depends) for v in self.all if v.causality == "output" and not v.alias
        )
        structure += "".join(unknown("ContinuousStateDerivative", f"der({x})", None) for x in self.rates)
        structure += "".join(unknown("InitialUnknown", name, self.initial) for name in self._initial_unknowns())
        structure += "".join(f'<EventIndicator valueReference="{k}"/>' for k in kinds.values())
        return self._document(3, way, scalars, structure, 'fmiVersion="3.0" instantiationToken="g"')

    def _initial(self, v: V) -> str:
        if v.causality in ("input", "independent"):
            return ""
        return "exact" if v.start is not None else "calculated"

    def _initial_unknowns(self) -> list[str]:
        kinds = ("output", "calculatedParameter")
        first = [v.name for v in self.all if v.causality in kinds and v.start is None and not v.alias]
        return first + [f"der({x})" for x in self.rates]

    def _document(self, version: int, way: Way, scalars: str, structure: str, head: str) -> str:
        states = {2: "canGetAndSetFMUstate", 3: "canGetAndSetFMUState"}[version]
        flags = {"modelIdentifier": self.name, states: self.saves}
        if way == "cs":
            flags["canHandleVariableCommunicationStepSize"] = self.any_step
        else:
            name = {2: "completedIntegratorStepNotNeeded", 3: "needsCompletedIntegratorStep"}[version]
            flags[name] = bool(self.completed) if version == 3 else not self.completed
        head += f' modelName="{self.name}"' + (f' numberOfEventIndicators="{len(self.zeros)}"' if version == 2 else "")
        part = f"<{'CoSimulation' if way == 'cs' else 'ModelExchange'} {_attributes(**flags)}/>"
        units = f"<UnitDefinitions>{self.units}</UnitDefinitions>" if self.units else ""
        types = f"<TypeDefinitions>{self.types}</TypeDefinitions>" if self.types else ""
        variables = f"<ModelVariables>\n{scalars}</ModelVariables>\n<ModelStructure>{structure}</ModelStructure>"
        return _document(head, f"{part}{units}{types}{variables}")

    def fmu(self, version: int = 2, way: Way = "cs") -> Path:
        """Return the FMU, named after the model."""
        return _fmu(self.c(), self.description(version, way), self.name, version)


def _c_value(value: object) -> str:
    return str(int(value)) if isinstance(value, bool) else repr(value)


def _attributes(**attributes: object) -> str:
    """Return XML attributes without the empty ones."""
    texts = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in attributes.items()}
    return " ".join(f"{k}={quoteattr(v)}" for k, v in texts.items() if v != "")


def _document(head: str, content: str) -> str:
    root = "fmiModelDescription"
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<{root} {head}>\n{content}\n</{root}>\n'


@cache
def _folder() -> Path:
    """Return the folder of FMUs, which the workers of a test session share."""
    shared = os.environ.get("XDG_CACHE_HOME") if "PYTEST_CURRENT_TEST" in os.environ else None
    if shared:
        folder = Path(shared) / "known"
        folder.mkdir(exist_ok=True)
        return folder
    alone = Path(tempfile.mkdtemp(prefix="known-"))
    atexit.register(shutil.rmtree, alone, ignore_errors=True)
    return alone


@cache
def _library(code: str) -> Path:
    """Return the compiled library; skip the test without a compiler."""
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    made = _folder() / f"{hashlib.sha256(code.encode()).hexdigest()[:16]}.so"
    if not made.exists():
        with tempfile.TemporaryDirectory(dir=_folder()) as place:
            (Path(place) / "model.c").write_text(code)
            library = Path(place) / "library.so"
            options = ["-O0", "-w", "-shared", "-fPIC", f"-I{place}"]
            subprocess.run([*command, *options, "-o", str(library), str(HERE / "kit.c"), "-lm"], check=True)
            library.replace(made)
    return made


@cache
def _fmu(code: str, description: str, name: str, version: int) -> Path:
    """Return the FMU, written once."""
    folder = _folder() / hashlib.sha256(f"{code}{description}".encode()).hexdigest()[:16]
    made = folder / f"{name}.fmu"
    if not made.exists():
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as place:
            draft = Path(place) / "draft"
            with zipfile.ZipFile(draft, "w") as archive:
                archive.writestr("modelDescription.xml", description)
                archive.write(_library(code), f"binaries/{'x86_64-linux' if version == 3 else 'linux64'}/{name}.so")
            draft.replace(made)
    return made
