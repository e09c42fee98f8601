"""config.h of a wrapped FMU: sizes, tables of variables, tokens."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from cosim.model.quantities import Parameter
from cosim.terms.code import TermCode

TOKENS = ("OWN_TOKEN", "ORIGINAL_TOKEN")
FLAGS = {"SHAPES": "shape_all", "PORTS": "port_inputs", "RATES": "added_rates", "READS": "readings"}


@dataclass
class Special:
    """A variable that is not only forwarded: its places among inputs, outputs, derivatives and own values."""

    input: int = -1
    output: int = -1
    rate: int = -1
    own: int = -1
    size: int = 1


@dataclass(frozen=True)
class WrapperConfig:
    """Everything that the C code of a wrapper must know.

    Attributes:
        inputs: Value references and start values of the terms' inputs.
        states: Value references of the terms' states.
        rates: Value references of the derivatives, in model exchange.
        own: Value reference → start value that the original's library does not have, or that the host may change.
        dampings: Value reference of the parameter of each direction, also in `own`.
        sizes: Value reference → number of elements of an array.
        any_step: Whether the original takes steps of any length.
    """

    terms: TermCode
    values: Mapping[str, float]
    first_parameter: int
    inputs: Mapping[int, float]
    states: Sequence[int]
    rates: Sequence[int]
    outputs: Sequence[int]
    own: Mapping[int, float] = field(default_factory=dict)
    dampings: Sequence[int] = ()
    sizes: Mapping[int, int] = field(default_factory=dict)
    substep: float = 0.0
    any_step: bool = False

    def text(self, tokens: tuple[str, str], library: str) -> str:
        """Return config.h.

        Args:
            tokens: GUIDs or instantiation tokens of the wrapper and of the original.
            library: Path of the original's library inside the original.
        """
        terms, parameters = self.terms, self.terms.parameters
        specials = self.specials()
        starts = [float(self.values.get(p.name, p.default)) for p in parameters]
        delay = [p.name for p in parameters].index(terms.delay) if terms.delay else -1
        names = ", ".join([*(c_text(p.name) for p in parameters), '""'])
        sizes = {
            "NU": len(self.inputs),
            "NX": len(terms.states),
            "NY": len(self.outputs),
            "NM": terms.memory,
            "NP": len(parameters) + 1,
            "PARAMETERS": len(parameters),
            "OWNS": len(self.own),
            "SPECIALS": len(specials),
            "DIRECTIONS": len(terms.directions),
            "FIRST_PARAMETER": f"{self.first_parameter}u",
            "DELAY": f"({delay})",
            "SUBSTEP": number(self.substep),
            "ANY_STEP": int(self.any_step),
            **{flag: int(hook in terms.hooks) for flag, hook in FLAGS.items()},
            **{name: c_text(token) for name, token in zip(TOKENS, tokens, strict=True)},
            "ORIGINAL": c_text(library),
        }
        rows = [
            f"    {{{reference}u, {s.input}, {s.output}, {s.rate}, {s.own}, {s.size}}}," for reference, s in specials
        ]
        return "\n".join(
            [
                "/* The variables on which the terms act, and which FMU this is. */",
                "#include <math.h>",
                *(f"#define {name} {value}" for name, value in sizes.items()),
                _references("INPUT_REFERENCE", self.inputs),
                _references("STATE_REFERENCE", self.states),
                _references("OUTPUT_REFERENCE", self.outputs),
                _references("OWN_REFERENCE", self.own),
                _numbers("INPUT_START", self.inputs.values()),
                _numbers("OWN_START", self.own.values()),
                _numbers("PARAMETER_START", starts),
                _numbers("PARAMETER_NEUTRAL", map(_neutral, parameters)),
                *self._directions(),
                f"static const char *const PARAMETER_NAME[] = {{{names}}};",
                "",
                "/* Places of a variable among inputs, outputs, derivatives and own values, and its elements. */",
                "typedef struct {",
                "    unsigned int reference;",
                "    int input, output, rate, own, size;",
                "} Special;",
                "",
                "static const Special SPECIAL[] = {",
                *rows,
                "    {0, -1, -1, -1, -1, 1}};",
                "",
            ]
        )

    def _directions(self) -> list[str]:
        """Return the tables of the directions; none without any."""
        directions = self.terms.directions
        if not directions:
            return []
        return [
            "/* Of each direction: damping with its place among own values, change, largest value; state, speed. */",
            _references("DAMPING_REFERENCE", self.dampings),
            _references("DAMPING_OWN", [[*self.own].index(reference) for reference in self.dampings]),
            _numbers("DAMPING_CHANGE", [d.change for d in directions]),
            _numbers("DAMPING_HIGH", [d.high for d in directions]),
            _references("BRAKED", [d.state for d in directions]),
            _numbers("SPEED", [d.speed for d in directions]),
            "#define library_direction(k, i, t, x, u, p) ((x)[NX * ((k) + 1) + (i)]) /* behind the states */",
        ]

    def specials(self) -> list[tuple[int, Special]]:
        """Return the special variables by value reference."""
        found: dict[int, Special] = {}
        for role, references in (
            ("input", self.inputs),
            ("output", self.outputs),
            ("rate", self.rates),
            ("own", self.own),
        ):
            for k, reference in enumerate(references):
                setattr(found.setdefault(reference, Special()), role, k)
        for reference, size in self.sizes.items():
            found.setdefault(reference, Special()).size = size
        return sorted(found.items())


def c_text(text: str) -> str:
    """Return a string literal of C."""
    plain = (chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in text.encode())
    return f'"{"".join(plain)}"'


def number(value: float) -> str:
    """Return a number literal of C."""
    if math.isnan(value):
        return "NAN"
    return repr(float(value)) if math.isfinite(value) else "HUGE_VAL" if value > 0 else "-HUGE_VAL"


def _neutral(p: Parameter) -> float:
    return math.nan if p.neutral is None else p.neutral


# Arrays end with one more element, because C has no empty arrays.
def _references(name: str, references: Sequence[int] | Mapping[int, float]) -> str:
    numbers = [f"{reference}u" for reference in references]
    return f"static const unsigned int {name}[] = {{{', '.join([*numbers, '0'])}}};"


def _numbers(name: str, values: object) -> str:
    numbers = [number(float(value)) for value in values]  # type: ignore[attr-defined]
    return f"static const double {name}[] = {{{', '.join([*numbers, '0.0'])}}};"
