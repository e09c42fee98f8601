"""FMUs of a few equations for FMI 1.0, 2.0 and 3.0, co-simulation and model exchange, from one description.

A library holds all interfaces of a model and is compiled once a session.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import quoteattr

from tests.compiled import library, pack

Way = Literal["cs", "me"]
C_TYPES = {
    "Float64": ("F64", "double"), "Float32": ("F32", "float"), "Int8": ("I8", "int8_t"), "UInt8": ("U8", "uint8_t"),
    "Int16": ("I16", "int16_t"), "UInt16": ("U16", "uint16_t"), "Int32": ("I32", "int32_t"),
    "UInt32": ("U32", "uint32_t"), "Int64": ("I64", "int64_t"), "UInt64": ("U64", "uint64_t"),
    "Boolean": ("BOOL", "bool"), "Enumeration": ("ENUM", "int64_t"), "String": ("STR", "char"),
    "Binary": ("BIN", "Bytes"),
}  # fmt: skip
FEWER = {"Float64": "Real", "Int32": "Integer", "Boolean": "Boolean", "String": "String", "Enumeration": "Enumeration"}
FIRST = {"parameter": "internal", "local": "internal", "fixed": "parameter", "tunable": "parameter"}  # words of FMI 1.0
RESERVED = ("time", "next", "changed", "more", "end", "ask", "initializing", "memory")  # fields of each model


DECLARATION = re.compile(r"([\w ]*?)(\w+)(?:\[(\d+)\])?(?::(-?\w+))?(?: = ([^{]*?))?(?: ?\{(.*)\})?")


@dataclass(frozen=True)
class V:
    """A variable.

    Attributes:
        size: Number of elements of an array, 0 for a scalar.
        alias: Name of the variable whose value reference this one has; "-x" for the negated alias of FMI 1.0.
        extra: Further XML attributes, such as a unit or a declared type.
    """

    name: str
    causality: str = "output"
    type: str = "Float64"
    variability: str = ""
    start: str | None = None
    size: int = 0
    alias: str = ""
    extra: Mapping[str, str] = field(default_factory=dict)
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


@cache
def declared(text: str) -> tuple[V, ...]:
    """Return the variables of `hidden String s = abc, tunable parameter k = 1, y {unit=K}, Int32 n[3], m:-n`."""
    found = []
    for declaration in text.split(", "):
        match = DECLARATION.fullmatch(declaration)
        assert match is not None, declaration
        words, name, size, alias, start, extra = match.groups()
        keys: dict[str, str] = {}
        for word in words.split():
            kind = "type" if word in C_TYPES else "variability" if word in ("discrete", "tunable") else "causality"
            keys[kind] = word
        readable = keys.get("causality") != "hidden"
        if not readable:
            keys["causality"] = "input"
        more = dict(pair.split("=") for pair in (extra or "").split())
        found.append(
            V(name, start=start, size=int(size or 0), alias=alias or "", extra=more, readable=readable, **keys)
        )
    return tuple(found)


def tag(element: str, /, *inside: str, **attributes: object) -> str:
    """Return an XML element; what is None is no attribute."""
    texts = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in attributes.items() if v is not None}
    head = " ".join([element, *(f"{k}={quoteattr(v)}" for k, v in texts.items())])
    return f"<{head}>{''.join(inside)}</{element}>"


@dataclass(frozen=True)
class Model:
    """A model by C expressions and statements, in which variables have their names.

    Attributes:
        declarations: Variables, as `declared` reads them.
        equations: Derivatives of states, such as `x' = v, v' = -x`.
        calc: Statements that compute outputs from states, inputs and `time`.
        depends: Output → inputs on which it depends directly; None declares nothing.
        start: Statements at the end of initialization.
        step: Statements at the end of a step of co-simulation, from `t` over `h`.
        zeros: Event indicators.
        event: Statements of an update of discrete states; they set `changed`, `more`, `end` and `next`.
        completed: Statements of a completed step of the integrator; they may set `ask`.
        initial: Output → inputs on which it depends in initialization.
        functions: Further C functions.
    """

    declarations: str
    equations: str = ""
    calc: str = ""
    depends: Mapping[str, tuple[str, ...]] | None = field(default_factory=dict)
    start: str = ""
    step: str = ""
    zeros: tuple[str, ...] = ()
    event: str = ""
    completed: str = ""
    initial: Mapping[str, tuple[str, ...]] | None = None
    units: str = ""
    types: str = ""
    functions: str = ""
    any_step: bool = True
    interpolates: bool = False
    name: str = "m"

    @property
    def rates(self) -> dict[str, str]:
        """Return the expressions of derivatives by states."""
        return dict(equation.split("' = ") for equation in self.equations.split(", ") if equation)

    @property
    def all(self) -> tuple[V, ...]:
        """Return the variables and the derivatives of the states."""
        return (*declared(self.declarations), *(V(f"der({x})", "local") for x in self.rates))

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
                return f"strcpy(m->{v.field}, {quoteattr(v.start or '')});"
            if v.type == "Binary":
                data = bytes.fromhex(v.start or "")
                return f"m->{v.field} = (Bytes){{{len(data)}, {{{', '.join(map(str, data))}}}}};"
            if v.size:
                return "".join(f"m->{v.field}[{k}] = {text};" for k, text in enumerate((v.start or "").split()))
            return f"m->{v.field} = {v.start}{'ull' if v.type == 'UInt64' else ''};"

        rows = "".join(
            f"{{{self.reference(v.name)}, {C_TYPES[v.type][0]}, offsetof(M, {v.field}), {v.size or 1}, "
            f"{int(v.readable)}}}, "
            for v in own
        )
        states = "".join(f"offsetof(M, {V(x).field}), " for x in self.rates)
        references = "".join(f"{self.reference(x)}, " for x in self.rates)
        derivatives = [(V(f"der({x})").field, body(f"({rate})")) for x, rate in self.rates.items()]
        shown = "".join(f"m->{name} = {rate};" for name, rate in derivatives)
        slopes = "".join(f"d[{k}] = m->{name};" for k, (name, _) in enumerate(derivatives))
        zeros = "".join(f"z[{k}] = {body(zero)};" for k, zero in enumerate(self.zeros))
        return (
            f"{self.functions}\n#define NAME {self.name}\n#define NX {len(self.rates)}\n#define NZ {len(self.zeros)}\n"
            "typedef struct { double time, next, memory[400], input_slopes[64][3];\n"
            "bool changed, more, end, ask, initializing;\n"
            f"{' '.join(map(declare, own))} }} M;\n"
            f"static const Row ROWS[] = {{{rows}{{899, F64, offsetof(M, time), 1, 1}}}};\n"
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
        variables = "".join(self._variable(v, version) for v in self.all if version < 3 or not v.alias)
        time: dict[str, Any] = {"name": "time", "valueReference": 899, "causality": "independent"}
        if version == 2:
            variables += tag("ScalarVariable", tag("Real"), **time, variability="continuous")
        elif version == 3:
            variables += tag("Float64", **time, variability="continuous")
            for k in range(len(self.zeros)):
                variables += tag("Float64", name=f"zero{k}", valueReference=900 + k, causality="local")
        inside = [
            tag(f"{kind}Definitions", text) for kind, text in (("Unit", self.units), ("Type", self.types)) if text
        ]
        inside.append(tag("ModelVariables", variables))
        head: dict[str, Any] = {"fmiVersion": f"{version}.0", "modelName": self.name}
        head["instantiationToken" if version == 3 else "guid"] = "g"
        if version < 3:
            head["numberOfEventIndicators"] = len(self.zeros)
        flags: dict[str, Any] = {"canHandleVariableCommunicationStepSize": self.any_step} if way == "cs" else {}
        if self.interpolates:
            flags["canInterpolateInputs"] = True
        if version == 1:
            head |= {"modelIdentifier": self.name, "numberOfContinuousStates": len(self.rates)}
            kind = tag("CoSimulation_StandAlone", tag("Capabilities", **flags))
            inside += [tag("Implementation", kind)] if way == "cs" else []
        else:
            flags |= {
                "modelIdentifier": self.name,
                {2: "canGetAndSetFMUstate", 3: "canGetAndSetFMUState"}[version]: True,
            }
            if way == "me" and version == 2:
                flags["completedIntegratorStepNotNeeded"] = not self.completed
            elif way == "me":
                flags["needsCompletedIntegratorStep"] = bool(self.completed)
            inside.insert(0, tag("CoSimulation" if way == "cs" else "ModelExchange", **flags))
            inside.append(tag("ModelStructure", self._structure(version)))
        return '<?xml version="1.0" encoding="UTF-8"?>\n' + tag("fmiModelDescription", *inside, **head)

    def _variable(self, v: V, version: int) -> str:
        who: dict[str, Any] = {"name": v.name, "valueReference": self.reference(v.name)}
        value: dict[str, Any] = {"start": v.start, **v.extra}
        if version == 1:
            if v.alias:
                who["alias"], value["start"] = "negatedAlias" if v.alias[0] == "-" else "alias", None
            direct = ""
            if v.causality == "output" and self.depends is not None:
                direct = tag("DirectDependency", *(tag("Name", x) for x in self.depends.get(v.name, ())))
            who |= {"causality": FIRST.get(v.causality, v.causality), "variability": FIRST.get(v.changes, v.changes)}
            return tag("ScalarVariable", tag(FEWER[v.type], **value), direct, **who)
        who |= {"causality": v.causality, "variability": v.changes}
        if v.causality != "input":
            who["initial"] = "calculated" if v.start is None else "exact"
        if v.name.startswith("der("):
            state = v.name[4:-1]
            value["derivative"] = self._index(state) if version == 2 else self.reference(state)
        if version == 2:
            return tag("ScalarVariable", tag(FEWER[v.type], **value), **who)
        inside = [tag("Dimension", start=v.size)] if v.size else []
        if v.start is not None and v.type in ("String", "Binary"):
            inside.append(tag("Start", value=value.pop("start")))
        inside += [tag("Alias", name=a.name) for a in self.all if a.alias == v.name]
        return tag(v.type, *inside, **who, **value)

    def _index(self, name: str) -> int:
        return 1 + [v.name for v in self.all].index(name)

    def _structure(self, version: int) -> str:
        outputs = [v for v in self.all if v.causality == "output" and not (v.alias and version == 3)]
        free = [v.name for v in self.all if v.causality in ("output", "calculatedParameter")
                and v.start is None and not v.alias]  # fmt: skip
        slopes = [f"der({x})" for x in self.rates]
        text = ""
        for second, third, names, depends in (
            ("Outputs", "Output", [v.name for v in outputs], self.depends),
            ("Derivatives", "ContinuousStateDerivative", slopes, None),
            ("InitialUnknowns", "InitialUnknown", free + slopes, self.initial),
        ):
            place = self._index if version == 2 else self.reference
            unknowns = ""
            for name in names:
                ends = None if depends is None else " ".join(str(place(x)) for x in depends.get(name, ()))
                where = {"index" if version == 2 else "valueReference": place(name)}
                unknowns += tag("Unknown" if version == 2 else third, **where, dependencies=ends)
            text += tag(second, unknowns) if version == 2 and unknowns else unknowns
        zeros = range(len(self.zeros)) if version == 3 else ()
        return text + "".join(tag("EventIndicator", valueReference=900 + k) for k in zeros)

    def fmu(self, version: int = 2, way: Way = "cs") -> Path:
        """Return the FMU, named after the model."""
        return _fmu(self.c(), self.description(version, way), self.name)

    def library(self) -> Path:
        """Return the compiled library."""
        return _library(self.c())


@cache
def _folder() -> Path:
    """Return the folder of libraries and FMUs, which the workers of a test session share."""
    shared = os.environ.get("XDG_CACHE_HOME") if "PYTEST_CURRENT_TEST" in os.environ else None
    folder = Path(shared or tempfile.mkdtemp()) / "known"
    folder.mkdir(exist_ok=True)
    return folder


@cache
def _library(code: str) -> Path:
    """Return the compiled library; skip the test without a compiler."""
    made = _folder() / f"{hashlib.sha256(code.encode()).hexdigest()[:16]}.so"
    if not made.exists():
        with tempfile.TemporaryDirectory(dir=_folder()) as place:
            (Path(place) / "model.c").write_text(code)
            draft = Path(place) / "draft.so"
            shutil.copy(library(Path(__file__).with_name("kit.c"), f"-I{place}", "-O0"), draft)
            draft.replace(made)
    return made


@cache
def _fmu(code: str, description: str, name: str) -> Path:
    """Return the FMU, written once a process."""
    made = Path(tempfile.mkdtemp(dir=_folder())) / f"{name}.fmu"
    return pack(made, description, _library(code))
