"""Printing of traced equations as functions that skip each dormant effect's block at run time.

Also: indicators of kinks, and directional derivatives block by block with the chain rule, which avoids an explicit
Jacobian.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from cosim.model.symbolic.languages import Language
from cosim.model.symbolic.trace import Block, Trace

AWAKE, DORMANT = 0, 1  # branches of a block


def kinks(blocks: Sequence[Block], expressions: Sequence[Any], moving: set[Any]) -> tuple[list[Block], list[Any]]:
    """Return blocks and symbols of kink indicators, each zero at a kink or jump.

    The indicator of an effect's block is 1 while the effect is dormant.

    Args:
        moving: Symbols that change while a solver steps; comparisons of other symbols are constant.
    """
    import sympy

    reach, gaps = set(moving), dict[Any, int | None]()
    for block in (*blocks, Block(dict(enumerate(expressions)))):
        for symbol, e in block.values.items():
            for relation in sorted(e.atoms(sympy.core.relational.Relational), key=str):
                gap = relation.lhs - relation.rhs
                if gap.free_symbols & reach and gap not in gaps and -gap not in gaps:
                    gaps[gap] = block.effect
            if e.free_symbols & reach:
                reach.add(symbol)
    more, indicators = [], []
    for k, (gap, effect) in enumerate(gaps.items()):
        symbol = sympy.Symbol(f"z{k}", real=True)
        more.append(Block({symbol: gap}, effect, {} if effect is None else {symbol: sympy.Integer(1)}))
        indicators.append(symbol)
    return more, indicators


def tangent(
    blocks: Sequence[Block], expressions: Sequence[Any], direction: Mapping[Any, Any]
) -> tuple[list[Block], list[Any]]:
    """Return the blocks and expressions of a directional derivative.

    Args:
        direction: Symbol → symbol of its rate of change.
    """
    import sympy

    slopes = dict(direction)

    def slope(e: Any) -> Any:
        moving = sorted(e.free_symbols & slopes.keys(), key=str)
        return sympy.Add(*(sympy.diff(e, s) * slopes[s] for s in moving))

    more = []
    for block in blocks:
        awake = {s: slope(e) for s, e in block.values.items()}
        asleep = {s: slope(e) for s, e in block.dormant.items()}
        moving = [s for s in awake if awake[s] != 0 or asleep.get(s, 0) != 0]
        symbols = {s: sympy.Symbol(f"d_{s}", real=True) for s in moving}
        if symbols:
            values = {symbols[s]: awake[s] for s in moving}
            rest = {} if block.effect is None else {symbols[s]: asleep[s] for s in moving}
            more.append(Block(values, block.effect, rest, block.title and f"{block.title}, slope"))
        slopes |= symbols
    return more, [slope(e) for e in expressions]


@dataclass(frozen=True)
class Nearby:
    """A call that evaluates sine and cosine of an angle, or a power, near a known point.

    Attributes:
        place: Index of the known point, one per call of a function.
    """

    place: int
    symbols: tuple[Any, ...]
    arguments: tuple[Any, ...]


def extract_calls(blocks: Sequence[Block], results: Sequence[Any]) -> tuple[list[Block], list[Any], list[Nearby]]:
    """Return blocks and results with symbols for sin, cos and powers, and the calls for their values.

    Powers with a constant exponent remain: squares, roots and reciprocals are cheap.
    """
    import sympy

    calls: dict[Any, Nearby] = {}

    def call(names: Sequence[str], arguments: tuple[Any, ...]) -> Nearby:
        symbols = tuple(sympy.Symbol(f"{name}_{len(calls)}", real=True) for name in names)
        return calls.setdefault(arguments, Nearby(len(calls), symbols, arguments))

    def replace(e: Any) -> Any:
        arguments = tuple(map(replace, e.args))
        if arguments != e.args:
            e = e.func(*arguments)
        if isinstance(e, (sympy.sin, sympy.cos)):
            return call(("sine", "cosine"), e.args).symbols[isinstance(e, sympy.cos)]
        if isinstance(e, sympy.Pow) and not e.exp.is_number:
            return call(("power",), e.args).symbols[0]
        return e

    def replace_all(values: Mapping[Any, Any]) -> dict[Any, Any]:
        return {s: replace(sympy.sympify(e)) for s, e in values.items()}

    needed = _needed_blocks(blocks, results)
    changed = [Block(replace_all(b.values), b.effect, replace_all(b.dormant), b.title) for b in needed]
    return changed, [replace(sympy.sympify(e)) for e in results], list(calls.values())


@dataclass
class _Node:
    """A block of the printed code: an effect's block has symbols and expressions for each of its branches."""

    branches: tuple[dict[Any, Any], ...]
    effect: int | None
    title: str
    call: Nearby | None = None
    within: tuple[list[_Node], list[_Node]] = field(default_factory=lambda: ([], []))  # needed by one branch only


def function(
    language: Language,
    name: str,
    arguments: str,
    blocks: Sequence[Block],
    results: Sequence[Any],
    places: Mapping[Any, str],
    *,
    calls: Sequence[Nearby] = (),
) -> str:
    """Return the text of `name(arguments, awake, out)`, with a branch for each effect.

    Args:
        calls: Evaluations extracted by `extract_calls`.
    """
    import sympy

    evaluated = {call.symbols: sympy.Tuple(*call.arguments) for call in calls}
    needed = _needed_blocks(blocks, [*results, *evaluated.values()])
    plain = {s: e for b in needed if b.effect is None for s, e in b.values.items()}
    temporary = (sympy.Symbol(f"c{k}", real=True) for k in count())
    replaced, reduced = sympy.cse([*plain.values(), *evaluated.values(), *results], symbols=temporary, optimizations=[])
    called, ends = reduced[len(plain) : len(plain) + len(calls)], reduced[len(plain) + len(calls) :]
    nodes = [_Node(({s: e},), None, "") for s, e in (*replaced, *zip(plain, reduced, strict=False))]
    nodes += [_Node((dict.fromkeys(c.symbols, e),), None, "", c) for c, e in zip(calls, called, strict=True)]
    nodes += [_Node((b.values, b.dormant), b.effect, b.title) for b in needed if b.effect is not None]
    ordered = _sink(_order(nodes, ends), ends)
    lines = [line for node in ordered for line in _print_node(node, language, places, "    ")]
    printer = language.printer(places)
    lines += ["    " + language.store.format(k, printer.doprint(e)) for k, e in enumerate(ends)]
    return language.frame(name, [*arguments.split(), "awake", "out"], "\n".join(lines).strip())


def _needed_blocks(blocks: Sequence[Block], results: Sequence[Any]) -> list[Block]:
    """Return the blocks required for the results, reduced to the used symbols."""
    import sympy

    needed = {s for e in results for s in sympy.sympify(e).free_symbols}
    reduced = []
    for block in reversed(blocks):
        values = {s: e for s, e in block.values.items() if s in needed}
        if values:
            dormant = {s: block.dormant[s] for s in values} if block.dormant else {}
            reduced.append(Block(values, block.effect, dormant, block.title))
            needed |= {s for e in (*values.values(), *dormant.values()) for s in e.free_symbols}
    return reduced[::-1]


def _order(nodes: Sequence[_Node], results: Sequence[Any]) -> list[_Node]:
    """Return the nodes in order of dependence."""
    maker = {s: node for node in nodes for s in node.branches[0]}
    done: dict[int, _Node] = {}

    def visit(expressions: Iterator[Any]) -> None:
        for symbol in sorted({s for e in expressions for s in e.free_symbols}, key=str):
            node = maker.get(symbol)
            if node is not None and id(node) not in done:
                visit(e for branch in node.branches for e in branch.values())
                done[id(node)] = node

    visit(iter(results))
    return list(done.values())


def _sink(nodes: list[_Node], results: Sequence[Any]) -> list[_Node]:
    """Move nodes used in a single branch into this branch, and return the remaining nodes."""
    homes: dict[Any, set[tuple[int, int] | None]] = {}

    def use(expressions: Sequence[Any], home: tuple[int, int] | None) -> None:
        for e in expressions:
            for symbol in e.free_symbols:
                homes.setdefault(symbol, set()).add(home)

    use(results, None)
    at, stay = {id(node): node for node in nodes}, []
    for node in reversed(nodes):
        if node.effect is None:
            own = set[tuple[int, int] | None]().union(*(homes.get(s, set()) for s in node.branches[0]))
            (home,) = own if len(own) == 1 else (None,)
            use(list(node.branches[0].values()), home)
            if home is not None:
                at[home[0]].within[home[1]].insert(0, node)
                continue
        else:
            for k, branch in enumerate(node.branches):
                use(list(branch.values()), (id(node), k))
        stay.append(node)
    return stay[::-1]


def _print_node(node: _Node, language: Language, places: Mapping[Any, str], indent: str) -> Iterator[str]:
    """Yield the lines of a node."""
    import sympy

    printer = language.printer(places)
    if node.call is not None:
        arguments = next(iter(node.branches[0].values()))
        words = (*map(str, node.call.symbols), *map(printer.doprint, arguments))
        form = language.angle if len(arguments) == 1 else language.power
        yield indent + form.format(node.call.place, *words)
        return
    if node.effect is None:
        ((symbol, e),) = node.branches[0].items()
        yield indent + language.local.format(symbol, printer.doprint(e))
        return
    if language.declared:
        yield indent + language.declared.format(", ".join(map(str, node.branches[0])))
    for k, opening in ((AWAKE, language.when.format(node.effect, node.title)), (DORMANT, language.otherwise)):
        yield indent + opening
        for inner in node.within[k]:
            yield from _print_node(inner, language, places, indent + "    ")
        names = (sympy.Symbol(f"{next(iter(node.branches[0]))}_{'cd'[k]}{j}", real=True) for j in count())
        values = node.branches[k]
        common, reduced = sympy.cse(list(values.values()), symbols=names, optimizations=[])
        for symbol, e in common:
            yield indent + "    " + language.local.format(symbol, printer.doprint(e))
        for symbol, e in zip(values, reduced, strict=True):
            yield indent + "    " + language.assign.format(symbol, printer.doprint(e))
    if language.end:
        yield indent + language.end


def places_of(trace: Trace, values: Mapping[str, str]) -> dict[Any, str]:
    """Return the places of symbols, such as `x[0]` or `u[1]`, with parameters from `values`."""
    s = trace.s
    groups = {"x": s.state, "u": s.command, "memory": trace.memory}
    places = {symbol: f"{array}[{k}]" for array, group in groups.items() for k, symbol in enumerate(group)}
    return {s.time: "t", trace.step: "h", **places, **{symbol: values[name] for name, symbol in s.parameters.items()}}
