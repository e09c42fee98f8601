"""Generated C code of a model: functions of its equations, and tables for equations.c."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

from cosim.fmi.ports import Port
from cosim.model.model import STIFF, Effect, Model, overrides
from cosim.model.namespaces import SymbolNamespace
from cosim.model.quantities import parameters_of
from cosim.model.symbolic.blocks import extract_calls, function, kinks, places_of, tangent
from cosim.model.symbolic.languages import C
from cosim.model.symbolic.trace import Block, Trace, Untraceable, switches
from cosim.model.symbolic.tracing_guard import number_guard
from cosim.storage.cache import fingerprint, load_or_make

MOST_SWITCHES = 4  # each doubles the generated code
LANGUAGE = C()
Function = tuple[str, str, str]  # name, arguments, text


class UnprintableModel(ValueError):
    """A model without C equivalent.

    Attributes:
        owner: Class at fault, if known.
        hook: Its method at fault.
        cure: Remedy.
    """

    def __init__(self, text: str, owner: type | None = None, hook: str = "", cure: str = "") -> None:
        super().__init__(text)
        self.owner, self.hook, self.cure = owner, hook, cure


@dataclass(frozen=True)
class GeneratedSources:
    """Generated code of a model: `model.c` and the definitions of `config.h`."""

    body: str
    sizes: Mapping[str, object]


def quote(text: str) -> str:
    """Return a C string, with octal escapes outside ASCII."""
    escaped = "".join(c if c.isascii() and c.isprintable() and c not in '"\\?' else _octal(c) for c in text)
    return f'"{escaped}"'


def _octal(character: str) -> str:
    return "".join(f"\\{byte:03o}" for byte in character.encode())


def number(value: float) -> str:
    """Return an exact C double."""
    text = repr(float(value))
    return {"inf": "INFINITY", "-inf": "-INFINITY"}.get(text, text)


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


class ModelPrinter:
    """Code generator of a model; C code of each position of the model's switches is chosen at run time."""

    def __init__(self, model: Model, ports: Sequence[Port]) -> None:
        self.model, self.ports = model, ports
        self.place = {port.name: k for k, port in enumerate(ports)}
        self.switches = switches(model)
        if len(self.switches) > MOST_SWITCHES:
            names = ", ".join(self.switches)
            text = f"{len(self.switches)} parameters are true or false ({names}); {MOST_SWITCHES} are printed at most"
            cure = "make the rest numbers that m.where looks at, or constants of the class"
            raise UnprintableModel(text, type(model), self.switches[MOST_SWITCHES].rpartition(".")[2], cure)
        positions = product((False, True), repeat=len(self.switches))
        try:
            self.variants = [Trace.of(model, dict(zip(self.switches, flags, strict=True))) for flags in positions]
        except Untraceable as error:
            raise UnprintableModel(str(error), error.owner, error.hook, error.cure) from error
        self.trace = self.variants[0]

    # -- sizes and places -----------------------------------------------------------------------

    @property
    def states(self) -> tuple[Any, ...]:
        """Return all states of the model, including those of the effects in its catalogue."""
        states: tuple[Any, ...] = self.trace.s.model.states
        return states

    @cached_property
    def delay(self) -> Any:
        """Return the effect that delays the command, if any."""
        return next((e for e in overrides(self.trace.effects, "shape", Effect) if e.delay), None)

    @cached_property
    def remembering(self) -> list[tuple[Any, Any]]:
        """Return (effect, quantity) for all memory except delays."""
        shaping = overrides(self.trace.effects, "shape", Effect)
        return [(e, q) for e in shaping if not e.delay for q in e.memory]

    def vr(self, name: str) -> int:
        """Return the value reference of a variable."""
        return self.place[name]

    def sources(self) -> GeneratedSources:
        """Return all generated C code of the model."""
        tables, texts = variable_tables(self.ports)
        functions, body_kinks, kinks_in_all, calls = load_or_make(self._serialize(), self._functions)
        parts = [tables, self._tables(), *functions, self._starts(), self._wake(), self._remembers(), self._counting()]
        delay = self.trace.effects.index(self.delay) if self.delay else -1
        sizes = {
            "VARIABLES": len(self.ports),
            "TEXTS": texts,
            "INPUTS": len(self.model.inputs),
            "OUTPUTS": len(self.model.outputs),
            "STATES": len(self.states),
            "MEMORIES": len(self.remembering),
            "OWN": len(self.states) + len(self.remembering) + 2 * len(self.model.inputs),
            "EFFECTS": len(self.trace.effects),
            "RANGES": len(self.model.valid),
            "BODY_KINKS": body_kinks,
            "KINKS": kinks_in_all,
            "NEAR": calls,
            "DELAY": delay,
            "DELAY_TIME": self.vr(f"{self.delay.name}.{self.delay.delay}") if self.delay else 0,
            "DELAY_LONGEST": number(_longest_delay(self.delay)) if self.delay else "0.0",
            "SHAPING": int(bool(overrides(self.trace.effects, "shape", Effect))),
            "SUBSTEP": number(self.model.substep),
            "STIFF": int(self.model.integrator == STIFF),
            "EXCHANGE": 1,
        }
        return GeneratedSources("\n".join(parts), sizes)

    # -- functions ------------------------------------------------------------------------------

    def _serialize(self) -> str:
        """Return a text that determines all generated functions, as key of the cache."""
        from sympy import srepr

        def as_text(blocks: Sequence[Block]) -> list[Any]:
            return [(srepr(list(b.values.items())), srepr(list(b.dormant.items())), b.effect, b.title) for b in blocks]

        parts: list[Any] = [fingerprint(("cosim.model.symbolic", "cosim.fmi.native"))]
        for trace in self.variants:
            ends = (trace.derivative, trace.outputs, trace.shaped, trace.remembered, trace.started, trace.memory)
            symbols = (trace.s.time, trace.step, *trace.s.state, *trace.s.command)
            places = [(name, self.vr(name), srepr(s)) for name, s in trace.s.parameters.items()]
            remembering = [bool(e.memory) for e in trace.effects]
            parts.append([as_text(trace.blocks), as_text(trace.shaping), *map(srepr, (*ends, list(symbols)))])
            parts.append([places, remembering])
        return repr((parts, [self.vr(name) for name in self.switches]))

    def _functions(self) -> tuple[list[str], int, int, int]:
        """Return C functions, and the numbers of kinks of derivatives and outputs, of all kinks, and of calls."""
        gaps = [self._kinks(trace) for trace in self.variants]
        sizes = [max(len(pair[k][1]) for pair in gaps) for k in (0, 1)]
        calls = [extract_calls(trace.blocks, trace.derivative) for trace in self.variants]
        printed = [self._variant(*of, sizes) for of in zip(self.variants, gaps, calls, strict=True)]
        merged = [self._merge([variant[k] for variant in printed]) for k in range(len(printed[0]))]
        return merged, sizes[0], sum(sizes), max(len(near) for _, _, near in calls)

    @staticmethod
    def _kinks(trace: Trace) -> tuple[tuple[list[Any], list[Any]], tuple[list[Any], list[Any]]]:
        """Return indicators of kinks, for derivatives and outputs, and for command shaping without memory."""
        moving = {*trace.s.state, *trace.s.command, trace.s.time}
        at_once = [b for b in trace.shaping if b.effect is None or not trace.effects[b.effect].memory]
        shaped = {*moving, *(s for b in trace.shaping for s in b.values)}
        return kinks(trace.blocks, [*trace.derivative, *trace.outputs], moving), kinks(at_once, [], shaped)

    def _variant(self, trace: Trace, gaps: Any, near: Any, sizes: Sequence[int]) -> list[Function]:
        import sympy

        s = trace.s
        direction = {symbol: sympy.Symbol(f"slope:{symbol}", real=True) for symbol in (*s.state, *s.command)}
        values = {name: f"p[{self.vr(name)}]" for name in s.parameters}
        places = places_of(trace, values)
        places |= {d: f"d{places[symbol]}" for symbol, d in direction.items()}
        slope_blocks, slopes = tangent(trace.blocks, [*trace.derivative, *trace.outputs], direction)
        shape_blocks, shape_slopes = tangent(trace.shaping, trace.shaped, {u: direction[u] for u in s.command})
        (body_kinks, body_gaps), (shape_kinks, shape_gaps) = gaps
        filled = [[*g, *[sympy.Integer(1)] * (n - len(g))] for g, n in zip((body_gaps, shape_gaps), sizes, strict=True)]
        body, shaping, n = trace.blocks, trace.shaping, len(trace.derivative)
        functions: list[tuple[str, str, list[Any], list[Any]]] = [
            ("outputs", "t x u p", body, trace.outputs),
            ("shape", "t h u memory p", shaping, [*trace.shaped, *trace.remembered]),
            ("remember", "t memory p", [], trace.started),
            ("indicators", "t x u p", [*body, *body_kinks], filled[0]),
            ("shape_indicators", "t h u memory p", [*shaping, *shape_kinks], filled[1]),
            ("derivative_slopes", "t x u p dx du", [*body, *slope_blocks], slopes[:n]),
            ("output_slopes", "t x u p dx du", [*body, *slope_blocks], slopes[n:]),
            ("shape_slopes", "t h u memory p dx du", [*shaping, *shape_blocks], shape_slopes),
        ]
        try:
            name, arguments = "derivatives", "t x u p near"
            derivatives = name, arguments, function(LANGUAGE, name, arguments, near[0], near[1], places, calls=near[2])
            rest = [(f, a, function(LANGUAGE, f, a, blocks, results, places)) for f, a, blocks, results in functions]
            return [derivatives, *rest]
        except ValueError as error:
            raise UnprintableModel(str(error)) from error

    def _merge(self, variants: Sequence[Function]) -> str:
        """Return a C function that calls the variant for the values of the model's switches."""
        name, arguments, text = variants[0]
        if all(other == text for _, _, other in variants):
            return text
        head, call = text.partition("\n")[0], ", ".join([*arguments.split(), "awake", "out"])
        texts = [
            t.replace(f"static void {name}(", f"static void {name}_{k}(", 1) for k, (_, _, t) in enumerate(variants)
        ]
        # in the order of `product`: the last switch is the lowest bit
        places = [self.vr(switch) for switch in self.switches]
        bits = " | ".join(f"(p[{vr}] != 0.0) << {k}" for k, vr in enumerate(reversed(places)))
        cases = "".join(f"    case {k}: {name}_{k}({call}); break;\n" for k in range(len(variants)))
        return "\n".join(texts) + f"\n{head}\n{{\n    switch ({bits}) {{\n{cases}    }}\n}}\n"

    def _starts(self) -> str:
        """Return C code that computes start values from parameters, unless the host sets the start values."""
        import sympy

        m, model = SymbolNamespace(), self.trace.s.model
        with number_guard():
            state, inputs = model.start_state(m), model.start_input()
        if any(t.s.model.start_state(m) != state or t.s.model.start_input() != inputs for t in self.variants):
            raise UnprintableModel("start values that a switch decides")
        printer = LANGUAGE.printer(places_of(self.trace, {n: f"p[{self.vr(n)}]" for n in self.trace.s.parameters}))

        def line(target: str, value: Any) -> str:
            return f"    {target} = {printer.doprint(sympy.sympify(value))};\n"

        starting = {q.name: inputs.get(q.name, q.start) for q in model.inputs}
        base = {q.name for q in model.base_states}
        text = "".join(
            line(f"x[{k}]", state.get(q.name, q.start) if q.name in base else q.start)
            for k, q in enumerate(self.states)
        )
        text += "".join(
            line(f"memory[{k}]", starting.get(q.name, q.start)) for k, (_, q) in enumerate(self.remembering)
        )
        text += "".join(line(f"u[{k}]", value) for k, value in enumerate(starting.values()))
        if self.delay:
            text += "".join(line(f"late[{k}]", starting.get(q.name, q.start)) for k, q in enumerate(self.delay.memory))
        unused = "(void)p, (void)x, (void)memory, (void)u, (void)late;"
        head = "static void starts(const double *p, double *x, double *memory, double *u, double *late)"
        return f"{head}\n{{\n    {unused}\n{text}}}\n"

    def _wake(self) -> str:
        """Return C code that marks effects as active if a parameter is not neutral."""
        lines = []
        for k, effect in enumerate(self.trace.effects):
            neutrals = [(self.vr(f"{effect.name}.{p.name}"), p.neutral) for p in parameters_of(effect)]
            tests = [f"p[{vr}] != {number(neutral)}" for vr, neutral in neutrals if neutral is not None]
            lines.append(f"    awake[{k}] = {' || '.join(tests) or '0'}; /* {effect.name} */\n")
        head = "static void wake(const double *p, unsigned char *awake)"
        return f"{head}\n{{\n    (void)p, (void)awake;\n{''.join(lines)}}}\n"

    def _remembers(self) -> str:
        """Return the C function `remembers`: whether an active effect has memory."""
        remembering = {e.name for e, _ in self.remembering}
        places = [k for k, e in enumerate(self.trace.effects) if e.name in remembering]
        head = "static int remembers(const unsigned char *awake)\n{\n    (void)awake;\n"
        return f"{head}    return {' || '.join(f'awake[{k}]' for k in places) or '0'};\n}}\n"

    def _counting(self) -> str:
        """Return the C function `counting`: name of an active effect that depends on the substep, or NULL."""
        remembering = {e.name for e, _ in self.remembering}
        clock = {self.trace.step, self.trace.s.time}
        lines = {}
        for block in self.trace.shaping:
            if block.effect is not None:
                name = self.trace.effects[block.effect].name
                symbols = set().union(*(e.free_symbols for e in block.values.values()))
                if symbols & (clock if name in remembering else {self.trace.step}):
                    lines[block.effect] = f"    if (awake[{block.effect}]) return {quote(name)};\n"
        head = "static const char *counting(const unsigned char *awake)\n{\n    (void)awake;\n"
        return f"{head}{''.join(lines.values())}    return NULL;\n}}\n"

    # -- tables ---------------------------------------------------------------------------------

    def _tables(self) -> str:
        places: Callable[[Iterable[str]], list[str]] = lambda names: [str(self.vr(n)) for n in names]  # noqa: E731
        delayed = [f"{self.delay.name}.{q.name}_start" for q in self.delay.memory] if self.delay else []
        if self.delay and len(delayed) != len(self.model.inputs):
            raise UnprintableModel(
                f"{self.delay.name} remembers {len(delayed)} commands; there are {len(self.model.inputs)}"
            )
        inputs = {q.name: k for k, q in enumerate(self.model.inputs)}
        range_inputs = [str(inputs[name]) for v in self.model.valid for name in v.inputs]
        ranges, first = [], 0
        for v in self.model.valid:
            limits = f"{number(v.low)}, {number(v.high)}"
            ranges.append(f"{{{quote(v.quantity)}, {first}, {len(v.inputs)}, {limits}, {quote(v.beyond)}}}")
            first += len(v.inputs)
        return (
            table("char *const", "STATE_NAME", [quote(q.name) for q in self.states])
            + table("int", "STATE_START", places(f"{q.name}_start" for q in self.states))
            + table("int", "MEMORY_START", places(f"{e.name}.{q.name}_start" for e, q in self.remembering))
            + table("int", "DELAY_START", places(delayed))
            + (table("int", "RANGE_INPUT", range_inputs) + table("Range", "RANGE", ranges) if ranges else "")
        )


def _longest_delay(delay: Any) -> float:
    """Return the longest possible delay [s]."""
    declared = next(p for p in parameters_of(delay) if p.name == delay.delay)
    return float(getattr(delay, "longest", declared.bounds[1]))
