"""Generated functions that skip the block of each dormant effect at run time.

The module also derives indicators of kinks, and directional derivatives without an explicit Jacobian, by the chain rule
from block to block.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from cosim.model.symbolic.languages import Language
from cosim.model.symbolic.symbols import Block, sympified


def kinks(blocks: Sequence[Block], expressions: Sequence[Any], moving: set[Any]) -> tuple[list[Block], list[Any]]:
    """Return blocks that compute kink indicators, which are zero at a kink or jump, and the indicators' symbols.

    The indicator of an effect's block is 1 while the effect is dormant.

    Args:
        moving: Symbols that change during a step of a solver. A comparison of other symbols cannot have a kink.
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
    """Return the blocks and expressions of a derivative along a direction.

    Args:
        direction: Symbol → symbol of its component in the direction.
    """
    import sympy

    slopes = dict(direction)

    def slope(e: Any) -> Any:
        moving = sorted(e.free_symbols & slopes.keys(), key=str)
        return sympy.Add(*(sympy.diff(e, s) * slopes[s] for s in moving))

    more = []
    for block in blocks:
        awake, asleep = ({s: slope(e) for s, e in of.items()} for of in (block.values, block.dormant))
        moving = [s for s in awake if awake[s] != 0 or asleep.get(s, 0) != 0]
        symbols = {s: sympy.Symbol(f"d_{s}", real=True) for s in moving}
        if symbols:
            values, rest = ({symbols[s]: of[s] for s in moving if s in of} for of in (awake, asleep))
            more.append(Block(values, block.effect, rest, block.title and f"{block.title}, slope"))
        slopes |= symbols
    return more, [slope(e) for e in expressions]


@dataclass(frozen=True)
class Nearby(Block):
    """A call of sin, cos or a power, computed cheaply from its known value at a nearby point.

    Attributes:
        values: Symbol of each result → arguments of the call.
        place: Index of the nearby point; each call has its own.
    """

    place: int = 0


def extract_calls(blocks: Sequence[Block], results: Sequence[Any]) -> tuple[list[Block], list[Any], list[Nearby]]:
    """Replace sin, cos and powers by symbols; return the blocks, the results, and the replaced calls.

    Powers with a constant exponent remain: squares, roots and reciprocals are cheap.
    """
    import sympy

    calls: dict[Any, Nearby] = {}

    def call(names: Sequence[str], arguments: tuple[Any, ...]) -> list[Any]:
        """Return the symbols of the results of a call, the same ones for the same arguments."""
        if arguments not in calls:
            symbols = [sympy.Symbol(f"{name}_{len(calls)}", real=True) for name in names]
            calls[arguments] = Nearby(dict.fromkeys(symbols, sympy.Tuple(*arguments)), place=len(calls))
        return [*calls[arguments].values]

    def replace(e: Any) -> Any:
        arguments = tuple(map(replace, e.args))
        if arguments != e.args:
            e = e.func(*arguments)
        if isinstance(e, (sympy.sin, sympy.cos)):
            return call(("sine", "cosine"), e.args)[isinstance(e, sympy.cos)]
        if isinstance(e, sympy.Pow) and not e.exp.is_number:
            return call(("power",), e.args)[0]
        return e

    changed = []
    for b in _needed_blocks(blocks, results):
        values, dormant = ({s: replace(sympy.sympify(e)) for s, e in of.items()} for of in (b.values, b.dormant))
        changed.append(Block(values, b.effect, dormant, b.title))
    return changed, [*map(replace, sympified(results))], list(calls.values())


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
    """Return the text of a function `name(arguments, awake, out)`, with a branch for each effect.

    Args:
        calls: Calls extracted by `extract_calls`.
    """
    import sympy

    evaluated = [next(iter(call.values.values())) for call in calls]
    needed = _needed_blocks(blocks, [*results, *evaluated])
    plain = {s: e for b in needed if b.effect is None for s, e in b.values.items()}
    temporary = (sympy.Symbol(f"c{k}", real=True) for k in count())
    replaced, reduced = sympy.cse([*plain.values(), *evaluated, *results], symbols=temporary, optimizations=[])
    called, ends = reduced[len(plain) : len(plain) + len(calls)], reduced[len(plain) + len(calls) :]
    nodes = [Block({s: e}) for s, e in (*replaced, *zip(plain, reduced, strict=False))]
    nodes += [replace(c, values=dict.fromkeys(c.values, e)) for c, e in zip(calls, called, strict=True)]
    nodes += [b for b in needed if b.effect is not None]
    maker = {s: node for node in nodes for s in node.values}
    ordered: dict[int, Block] = {}

    def visit(expressions: Iterator[Any]) -> None:
        """Append the blocks of the expressions to `ordered`, dependencies first."""
        for symbol in sorted({s for e in expressions for s in e.free_symbols}, key=str):
            node = maker.get(symbol)
            if node is not None and id(node) not in ordered:
                visit(e for branch in (node.values, node.dormant) for e in branch.values())
                ordered[id(node)] = node

    visit(iter(ends))
    homes: dict[Any, set[Any]] = {s: {None} for e in ends for s in e.free_symbols}  # symbol → branches with it
    within = defaultdict[Any, list[Block]](list)  # branch → its blocks; None: outside all branches
    for node in reversed(ordered.values()):
        home = None
        if node.effect is None:  # a block whose results a single branch uses moves into that branch
            own = set().union(*(homes.get(s, set()) for s in node.values))
            (home,) = own if len(own) == 1 else (None,)
        for k, branch in enumerate((node.values, node.dormant)):
            for symbol in {s for e in branch.values() for s in e.free_symbols}:
                homes.setdefault(symbol, set()).add(home if node.effect is None else (id(node), k))
        within[home].append(node)
    printer = language.printer(places)

    def lines_of(home: Any, indent: str) -> Iterator[str]:
        """Yield the lines of the blocks in a branch."""
        for node in reversed(within[home]):
            symbols, expressions = [*node.values], [*node.values.values()]
            if isinstance(node, Nearby):
                form = language.angle if len(expressions[0]) == 1 else language.power
                yield indent + form.format(node.place, *symbols, *map(printer.doprint, expressions[0]))
                continue
            if node.effect is None:
                yield indent + language.local.format(symbols[0], printer.doprint(expressions[0]))
                continue
            if language.declared:
                yield indent + language.declared.format(", ".join(map(str, symbols)))
            openings = language.when.format(node.effect, node.title), language.otherwise
            for k, (opening, branch) in enumerate(zip(openings, (node.values, node.dormant), strict=True)):
                yield indent + opening
                yield from lines_of((id(node), k), indent + "    ")
                names = (sympy.Symbol(f"{symbols[0]}_{'cd'[k]}{j}", real=True) for j in count())
                common, reduced = sympy.cse([*branch.values()], symbols=names, optimizations=[])
                for form, lines in ((language.local, common), (language.assign, zip(branch, reduced, strict=True))):
                    for symbol, e in lines:
                        yield indent + "    " + form.format(symbol, printer.doprint(e))
            if language.end:
                yield indent + language.end

    lines = [
        *lines_of(None, "    "),
        *("    " + language.store.format(k, printer.doprint(e)) for k, e in enumerate(ends)),
    ]
    return language.frame(name, [*arguments.split(), "awake", "out"], "\n".join(lines).strip())


def _needed_blocks(blocks: Sequence[Block], results: Sequence[Any]) -> list[Block]:
    """Return the blocks required for the results, without symbols that the results do not use."""
    needed = {s for e in sympified(results) for s in e.free_symbols}
    reduced = []
    for block in reversed(blocks):
        if values := {s: e for s, e in block.values.items() if s in needed}:
            dormant = {s: block.dormant[s] for s in values} if block.dormant else {}
            reduced.append(Block(values, block.effect, dormant, block.title))
            needed |= {s for e in (*values.values(), *dormant.values()) for s in e.free_symbols}
    return reduced[::-1]
