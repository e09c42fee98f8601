"""Generated C code of a model: functions for its equations, and tables for equations.c."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import Any

from cosim.fmi.ports import Port
from cosim.model.model import STIFF, Effect, Model, overrides
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.blocks import extract_calls, function, kinks, tangent
from cosim.model.symbolic.languages import C
from cosim.model.symbolic.symbols import number_guard
from cosim.model.symbolic.trace import Trace, UnprintableModel

MOST_SWITCHES = 4  # Boolean parameters of a model; each one doubles the generated code
LANGUAGE = C()
Function = tuple[str, str, str]  # name, arguments, text


def quote(text: str) -> str:
    """Return a text as a C string, with octal escapes outside printable ASCII."""
    plain = (chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in text.encode())
    return f'"{"".join(plain)}"'


def number(value: float) -> str:
    """Return a value as an exact C double."""
    text = repr(float(value))
    return {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}.get(text, text)


def table(kind: str, name: str, rows: Iterable[str]) -> str:
    """Return a constant table in C; an empty table gets a 0, because C allows no empty arrays."""
    inner = "".join(f"    {row},\n" for row in rows) or "    0,\n"
    return f"static const {kind} {name}[] = {{\n{inner}}};\n"


def variable_tables(ports: Sequence[Port]) -> tuple[str, int]:
    """Return the tables `variables` and `texts`, and the number of texts."""
    rows: list[str] = []
    texts: list[str] = []
    for port in ports:
        start = number(port.start) if not isinstance(port.start, str) else f"{len(texts)}.0"
        if isinstance(port.start, str):
            texts.append(quote(port.start))
        low, high = map(number, port.bounds)
        kind, causality = port.kind.upper(), port.causality.upper()
        rows.append(f"{{{quote(port.name)}, {quote(port.unit)}, {kind}, {causality}, {start}, {low}, {high}}}")
    variables = table("Variable", "variables", [*rows, '{"", "", REAL, PARAMETER, 0.0, 0.0, 0.0}'])
    strings = table("char *const", "texts", [*texts, '""'])
    return variables.replace("[]", "[VARIABLES + 1]", 1) + strings.replace("[]", "[TEXTS + 1]", 1), len(texts)


def _c_function(head: str, lines: str) -> str:
    """Return a C function that need not use all of its arguments."""
    unused = ", ".join(f"(void){name}" for name in re.findall(r"(\w+)[,)]", head))
    return f"static {head}\n{{\n    {unused};\n{lines}}}\n"


class ModelPrinter:
    """Generator of a model's C code. Boolean parameters choose among variants of the code at run time."""

    def __init__(self, model: Model, ports: Sequence[Port]) -> None:
        self.model = model
        self.place = {port.name: k for k, port in enumerate(ports)}
        self.switches = [name for name, p in model.declared.items() if isinstance(p.default, bool)]
        if len(self.switches) > MOST_SWITCHES:
            names = ", ".join(self.switches)
            text = f"{len(self.switches)} Boolean parameters ({names}); at most {MOST_SWITCHES} are supported"
            cure = "replace the others by numbers used in m.where, or by constants of the class"
            raise UnprintableModel(text, type(model), self.switches[MOST_SWITCHES].rpartition(".")[2], cure)
        positions = product((False, True), repeat=len(self.switches))
        self.variants = [Trace(model, dict(zip(self.switches, flags, strict=True))) for flags in positions]
        self.trace = self.variants[0]
        self.states = self.trace.s.model.states  # including states of the effects in the catalogue
        self.shaping = overrides(self.trace.effects, "shape", Effect)
        self.delay = next((e for e in self.shaping if e.delay), None)
        self.remembering = [(e, q) for e in self.shaping if not e.delay for q in e.memory]

    def sources(self) -> tuple[str, dict[str, object]]:
        """Return all generated C code of the model, and the definitions of its `config.h`."""
        indicators = []  # of kinks, per variant: for derivatives and outputs, and for shaping without memory
        for trace in self.variants:
            moving = {*trace.s.state, *trace.s.command, trace.s.time}
            at_once = [b for b in trace.shaping if b.effect is None or not trace.effects[b.effect].memory]
            shaped = moving.union(*(b.values for b in trace.shaping))
            ends = [*trace.derivative, *trace.outputs]
            indicators.append((kinks(trace.blocks, ends, moving), kinks(at_once, [], shaped)))
        counts = [max(len(pair[k][1]) for pair in indicators) for k in (0, 1)]
        calls = [extract_calls(trace.blocks, trace.derivative) for trace in self.variants]
        printed = [self._variant(*of, counts) for of in zip(self.variants, indicators, calls, strict=True)]
        functions = [self._merge(variants) for variants in zip(*printed, strict=True)]
        parts = [self._tables(), *functions, self._starts(), *self._questions()]
        delay, longest = self.delay, 0.0
        if delay:
            bounds = {p.name: p.bounds for p in parameters_of(delay)}
            longest = float(getattr(delay, "longest", bounds[delay.delay][1]))
        sizes: dict[str, object] = {
            "STATES": len(self.states),
            "MEMORIES": len(self.remembering),
            "OWN": len(self.states) + len(self.remembering) + 2 * len(self.model.inputs),
            "EFFECTS": len(self.trace.effects),
            "RANGES": len(self.model.valid),
            "BODY_KINKS": counts[0],
            "KINKS": sum(counts),
            "NEAR": max(len(near) for _, _, near in calls),
            "DELAY": self.trace.effects.index(delay) if delay else -1,
            "DELAY_TIME": self.place[f"{delay.name}.{delay.delay}"] if delay else 0,
            "DELAY_LONGEST": number(longest),
            "SHAPING": int(bool(self.shaping)),
            "SUBSTEP": number(self.model.substep),
            "STIFF": int(self.model.integrator == STIFF),
            "EXCHANGE": 1,
        }
        return "\n".join(parts), sizes

    def _variant(self, trace: Trace, indicators: Any, near: Any, sizes: Sequence[int]) -> list[Function]:
        """Return the functions for certain values of the Boolean parameters."""
        import sympy

        s, body, shaping, n = trace.s, trace.blocks, trace.shaping, len(trace.derivative)
        direction = {symbol: sympy.Symbol(f"slope:{symbol}", real=True) for symbol in (*s.state, *s.command)}
        places = trace.places(self.place)
        places |= {d: f"d{places[symbol]}" for symbol, d in direction.items()}
        slope_blocks, slopes = tangent(body, [*trace.derivative, *trace.outputs], direction)
        shape_blocks, shape_slopes = tangent(shaping, trace.shaped, {u: direction[u] for u in s.command})
        (body_kinks, shape_kinks), gaps = zip(*indicators, strict=True)
        body_gaps, shape_gaps = ([*g, *[sympy.Integer(1)] * (k - len(g))] for g, k in zip(gaps, sizes, strict=True))
        functions: list[tuple[str, str, list[Any], list[Any]]] = [
            ("derivatives", "t x u p near", near[0], near[1]),
            ("outputs", "t x u p", body, trace.outputs),
            ("shape", "t h u memory p", shaping, [*trace.shaped, *trace.remembered]),
            ("remember", "t memory p", [], trace.started),
            ("indicators", "t x u p", [*body, *body_kinks], body_gaps),
            ("shape_indicators", "t h u memory p", [*shaping, *shape_kinks], shape_gaps),
            ("derivative_slopes", "t x u p dx du", [*body, *slope_blocks], slopes[:n]),
            ("output_slopes", "t x u p dx du", [*body, *slope_blocks], slopes[n:]),
            ("shape_slopes", "t h u memory p dx du", [*shaping, *shape_blocks], shape_slopes),
        ]
        texts: list[Function] = []
        try:
            for name, words, blocks, ends in functions:
                calls = near[2] if "near" in words else ()
                texts.append((name, words, function(LANGUAGE, name, words, blocks, ends, places, calls=calls)))
        except ValueError as error:
            raise UnprintableModel(str(error)) from error
        return texts

    def _merge(self, variants: Sequence[Function]) -> str:
        """Return a C function that calls the variant that belongs to the values of the Boolean parameters."""
        name, arguments, text = variants[0]
        if all(other == text for _, _, other in variants):
            return text
        head, call = text.partition("\n")[0], ", ".join([*arguments.split(), "awake", "out"])
        texts = [
            t.replace(f"static void {name}(", f"static void {name}_{k}(", 1) for k, (_, _, t) in enumerate(variants)
        ]
        # as in `product`, the last Boolean parameter is the lowest bit
        places = [self.place[switch] for switch in self.switches]
        bits = " | ".join(f"(p[{vr}] != 0.0) << {k}" for k, vr in enumerate(reversed(places)))
        cases = "".join(f"    case {k}: {name}_{k}({call}); break;\n" for k in range(len(variants)))
        return "\n".join(texts) + f"\n{head}\n{{\n    switch ({bits}) {{\n{cases}    }}\n}}\n"

    def _starts(self) -> str:
        """Return C code that computes parameter-dependent start values which the host has not set."""
        import sympy

        m, model = SymbolNamespace(), self.trace.s.model
        with number_guard():
            state, inputs = model.start_state(m), model.start_input()
        if any(t.s.model.start_state(m) != state or t.s.model.start_input() != inputs for t in self.variants):
            raise UnprintableModel("start values that a switch decides")
        printer = LANGUAGE.printer(self.trace.places(self.place))
        starting = {q.name: inputs.get(q.name, q.start) for q in model.inputs}
        base = {q.name for q in model.base_states}
        starts = {
            "x": [state.get(q.name, q.start) if q.name in base else q.start for q in self.states],
            "memory": [starting.get(q.name, q.start) for _, q in self.remembering],
            "u": [*starting.values()],
            "late": [starting.get(q.name, q.start) for q in self.delay.memory] if self.delay else [],
        }
        text = "".join(
            f"    {array}[{k}] = {printer.doprint(sympy.sympify(value))};\n"
            for array, values in starts.items()
            for k, value in enumerate(values)
        )
        return _c_function("void starts(const double *p, double *x, double *memory, double *u, double *late)", text)

    def _questions(self) -> Iterator[str]:
        """Yield three C functions on effects.

        `wake` marks the effects with a parameter that is not neutral as active. `remembers` returns true if an active
        effect has memory. `counting` returns the name of an active effect whose result depends on the substep, or NULL.
        """
        effects, remembering = self.trace.effects, {e.name for e, _ in self.remembering}
        lines = ""
        for k, effect in enumerate(effects):
            neutrals = [(self.place[f"{effect.name}.{p.name}"], p.neutral) for p in parameters_of(effect)]
            tests = [f"p[{vr}] != {number(neutral)}" for vr, neutral in neutrals if neutral is not None]
            lines += f"    awake[{k}] = {' || '.join(tests) or '0'}; /* {effect.name} */\n"
        yield _c_function("void wake(const double *p, unsigned char *awake)", lines)

        active = " || ".join(f"awake[{k}]" for k, e in enumerate(effects) if e.name in remembering)
        yield _c_function("int remembers(const unsigned char *awake)", f"    return {active or '0'};\n")

        clock, counting = {self.trace.step, self.trace.s.time}, {}
        for block in self.trace.shaping:
            if block.effect is not None:
                name = effects[block.effect].name
                symbols = set().union(*(e.free_symbols for e in block.values.values()))
                if symbols & (clock if name in remembering else {self.trace.step}):
                    counting[block.effect] = f"    if (awake[{block.effect}]) return {quote(name)};\n"
        lines = "".join(counting.values()) + "    return NULL;\n"
        yield _c_function("const char *counting(const unsigned char *awake)", lines)

    def _tables(self) -> str:
        """Return C tables of the value references of start values and of the model's ranges of validity."""
        starts = {
            "STATE_START": [q.name for q in self.states],
            "MEMORY_START": [f"{e.name}.{q.name}" for e, q in self.remembering],
            "DELAY_START": [f"{self.delay.name}.{q.name}" for q in self.delay.memory] if self.delay else [],
        }
        text = table("char *const", "STATE_NAME", [quote(q.name) for q in self.states])
        for name, quantities in starts.items():
            text += table("int", name, [str(self.place[f"{q}_start"]) for q in quantities])
        inputs = [q.name for q in self.model.inputs]
        range_inputs: list[str] = []
        ranges: list[str] = []
        for v in self.model.valid:
            sizes = f"{len(range_inputs)}, {len(v.inputs)}, {number(v.low)}, {number(v.high)}"
            ranges.append(f"{{{quote(v.quantity)}, {sizes}, {quote(v.beyond)}}}")
            range_inputs += [str(inputs.index(name)) for name in v.inputs]
        if ranges:
            text += table("int", "RANGE_INPUT", range_inputs) + table("Range", "RANGE", ranges)
        return text
