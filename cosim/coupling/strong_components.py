"""Algebraic loops: components that need each other's outputs of the same time, and their order within the loop."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from graphlib import TopologicalSorter
from itertools import permutations

Edge = tuple[str, str, str, str]  # source component, target component, target input, source output
MOST_PERMUTED = 6  # components of a loop, beyond which their order is that of the file


def order_with_loops(
    components: Iterable[str], edges: Sequence[Edge], immediate: Sequence[bool]
) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Return an order of all components, and the loops.

    Args:
        immediate: For each connection, whether its target needs the value of the same time.
    """
    names = list(components)
    ends = [(source, target) for (source, target, *_), now in zip(edges, immediate, strict=True) if now]
    groups = strong_components(names, ends)
    ordered = [_order_within(group, ends) for group in _sort(groups, ends)]
    selfish = {source for source, target in ends if source == target}
    loops = tuple(group for group in ordered if len(group) > 1 or group[0] in selfish)
    return tuple(name for group in ordered for name in group), loops


def _sort(groups: Sequence[tuple[str, ...]], ends: Iterable[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Return groups in the order of their connections."""
    group_of = {name: k for k, group in enumerate(groups) for name in group}
    sorter: TopologicalSorter[int] = TopologicalSorter({k: set() for k in range(len(groups))})
    for source, target in ends:
        if group_of[source] != group_of[target]:
            sorter.add(group_of[target], group_of[source])
    return [groups[k] for k in sorter.static_order()]


def strong_components(names: Sequence[str], ends: Collection[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Return the groups of names that reach each other."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    place = {name: k for k, name in enumerate(names)}
    rows, columns = [place[source] for source, _ in ends], [place[target] for _, target in ends]
    graph = csr_array(([1] * len(rows), (rows, columns)), shape=(len(names), len(names)))
    _, labels = connected_components(graph, directed=True, connection="strong")
    groups: dict[int, list[str]] = {}
    for name, label in zip(names, labels.tolist(), strict=True):
        groups.setdefault(label, []).append(name)
    return [tuple(group) for group in groups.values()]


def torn(group: Sequence[str], ends: Iterable[tuple[str, str]]) -> list[bool]:
    """Return for each connection whether it leads back."""
    place = {name: k for k, name in enumerate(group)}
    return [place[source] >= place[target] for source, target in ends]


def _order_within(group: tuple[str, ...], ends: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    """Return the order with the fewest connections back."""
    inner = [end for end in ends if set(end) <= set(group)]
    if not 1 < len(group) <= MOST_PERMUTED:
        return group
    return min(permutations(group), key=lambda order: sum(torn(order, inner)))
