"""Values with units, and the rule of units of each operation of a formula."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.base.messages import Template
from cosim.base.units import coherent, combined_unit, conversion, parse
from cosim.viewing import messages

LARGEST_ROOT = 12  # denominator of an exponent of a unit
SAME = 1e-9  # of the weight of a temperature
TEMPERATURE, ANGLE, TIME = {"K": 1}, {"rad": 1}, {"s": 1}


@dataclass(frozen=True)
class Quantity:
    """Values at all rows of a run, or one number, with their unit.

    Attributes:
        text: Part of the formula, for messages.
        weight: Number of temperatures in the values: 1 for a temperature, 0.5 for its half, 0 for a difference.
        is_either: Whether this may be a temperature or a difference, as a signal in K.
    """

    values: Array | float
    unit: str
    text: str
    weight: float = 0.0
    is_either: bool = False

    @property
    def is_number(self) -> bool:
        """Return whether this is a number of the formula."""
        return not self.unit and np.ndim(self.values) == 0

    @property
    def has_offset(self) -> bool:
        """Return whether zero in the unit is not zero in SI."""
        unit = parse(self.unit) if self.unit else None
        return unit is not None and unit.offset != 0.0


def signal(values: Array, unit: str, text: str) -> Quantity:
    """Return the values of a signal; those in degC are temperatures, not differences."""
    made, parsed = Quantity(values, unit, text), parse(unit) if unit else None
    if parsed is None or parsed.exponents != TEMPERATURE:
        return made
    return replace(made, weight=1.0) if parsed.offset else replace(made, is_either=True)


def refuse(template: Template, *parts: Quantity, **fields: Any) -> NoReturn:
    """Refuse a formula; parts are named in the message by their texts and units."""
    for k, part in enumerate(parts):
        fields |= {f"text{k}": part.text, f"unit{k}": part.unit or "1"}
    raise InputError.at(Path("formula"), template(**fields))


# -- rules of units -----------------------------------------------------------------------------------


def in_one_unit(parts: Sequence[Quantity], weights: Sequence[float]) -> tuple[list[Any], str]:
    """Return values in the unit of the first part that has one; numbers and signals without unit take that unit.

    Args:
        weights: Weight of each part.

    Raises:
        InputError: Two units measure different quantities.
    """
    first = next((part for part in parts if part.unit), parts[0])
    values = []
    for part, weight in zip(parts, weights, strict=True):
        by = conversion(part.unit, first.unit)
        if by is None:
            refuse(messages.OTHER_QUANTITY, first, part)
        values.append(part.values if by == (1.0, 0.0) else by.factor * part.values + weight * by.offset)
    return values, first.unit


def add(left: Quantity, right: Quantity, text: str, sign: float = 1.0) -> Quantity:
    """Return a sum or a difference in the first unit; kelvin beside degC are differences in sums, else temperatures."""
    weights = [part.weight for part in (left, right)]
    if sign < 0.0:
        weights = _weights_of_temperatures((left, right), numbers=False)
    (first, second), unit = in_one_unit((left, right), weights)
    return _sum(Quantity(first + sign * second, unit, text, weights[0] + sign * weights[1]))


def _sum(made: Quantity) -> Quantity:
    """Return a sum; a difference of temperatures in degC is in K."""
    return difference(made) if made.has_offset and abs(made.weight) < SAME else made


def _weights_of_temperatures(parts: Sequence[Quantity], *, numbers: bool) -> list[float]:
    """Return weights of parts that are compared: beside a temperature in degC, kelvin are temperatures too."""
    weight = next((part.weight for part in parts if part.has_offset), 0.0)
    return [weight if part.is_either or (numbers and not part.unit) else part.weight for part in parts]


def alike(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return the smaller or the larger of values, converted to one unit."""
    for part in parts:
        check_result(part)
    weights = _weights_of_temperatures(parts, numbers=True)
    values, unit = in_one_unit(parts, weights)
    return _sum(Quantity(function(*values), unit, text, weights[0]))


def length(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return the length of a vector with parts in one unit."""
    bare = [absolute(part) for part in parts]
    values, unit = in_one_unit(bare, [0.0] * len(bare))
    return Quantity(function(*values), unit, text)


def direction(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return the angle of a vector with parts in one unit."""
    return replace(length(function, parts, text), unit="rad")


def same_unit(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return a value in the unit of the argument."""
    (part,) = map(absolute, parts)
    return Quantity(function(part.values), part.unit, text)


def ratio(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return a value without dimension; see `argument`."""
    return Quantity(function(*map(argument, parts)), "1", text)


def angle(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return an angle from an argument without dimension."""
    return replace(ratio(function, parts, text), unit="rad")


def root(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return the square root, in the root of the unit."""
    return power(parts[0], Quantity(0.5, "", "0.5"), text)


def bare(function: Callable[..., Any], parts: Sequence[Quantity], text: str) -> Quantity:
    """Return a value without unit: the number as it is drawn."""
    return Quantity(function(parts[0].values), "", text)


def product(left: Quantity, right: Quantity, text: str, times: int = 1) -> Quantity:
    """Return a product, or with `times` = −1 a quotient, in the product of the units; degC count in K.

    A number keeps the unit of the other part. A signal without unit, or with an unknown one, leaves no unit.
    """
    operation = np.multiply if times > 0 else np.divide
    if right.is_number or (left.is_number and times > 0):
        other = left if right.is_number else right
        factor = float(right.values if right.is_number else left.values)
        weight = other.weight * factor if times > 0 else other.weight / factor if factor else 0.0
        return _sum(Quantity(operation(left.values, right.values), other.unit, text, weight))
    first, second = absolute(left), absolute(right)
    values = operation(first.values, second.values)
    factors = [(part.unit, by) for part, by in ((first, 1), (second, times)) if not part.is_number]
    combined = combined_unit(factors) if all(unit for unit, _ in factors) else None
    if combined is None:
        return Quantity(values, "", text)
    return Quantity(combined[1] * values, combined[0], text)


def power(left: Quantity, right: Quantity, text: str) -> Quantity:
    """Return a power; the exponent of a unit is a number of the formula, that of a signal needs a base without one."""
    exponent, base = argument(right), absolute(left)
    unit = parse(base.unit) if base.unit else None
    if not base.unit or (unit is not None and not unit.exponents):
        by = 1.0 if unit is None else unit.factor
        return Quantity(np.power(by * np.asarray(base.values), exponent), base.unit and "1", text)
    if np.ndim(exponent):
        refuse(messages.UNIT_WITH_POWERS, base, exponent=right.text)
    times = Fraction(float(exponent)).limit_denominator(LARGEST_ROOT) if np.isfinite(exponent) else Fraction(0)
    combined = combined_unit([(base.unit, times)])
    if combined is None or abs(float(times) - float(exponent)) > SAME:
        refuse(messages.NO_ROOT, base, exponent=right.text)
    return Quantity(combined[1] * np.power(np.asarray(base.values), exponent), combined[0], text)


def per_time(made: Quantity, values: Array, text: str) -> Quantity:
    """Return a derivative: the unit of its argument over s."""
    return product(replace(made, values=values, text=text), Quantity(np.ones(1), "s", "t"), text, -1)


def over_time(made: Quantity, values: Array, text: str) -> Quantity:
    """Return an integral: the unit of its argument times s."""
    return product(replace(made, values=values, text=text), Quantity(np.ones(1), "s", "t"), text)


# -- zero and size of units ---------------------------------------------------------------------------


def absolute(part: Quantity) -> Quantity:
    """Return a quantity whose zero is that of SI: temperatures in degC become K."""
    unit = parse(part.unit) if part.has_offset else None
    if unit is None:
        return part
    values = unit.factor * part.values + part.weight * unit.offset
    return replace(part, values=values, unit=coherent(part.unit))


def difference(part: Quantity) -> Quantity:
    """Return a quantity of whose unit only the size counts: differences in degC become K."""
    return absolute(replace(part, weight=0.0))


def argument(part: Quantity) -> Any:
    """Return the argument of a function of numbers: an angle in rad, a time in s, a ratio.

    Raises:
        InputError: The argument is in another unit.
    """
    if not part.unit:
        return part.values
    unit = parse(part.unit)
    if unit is None or unit.exponents not in ({}, ANGLE, TIME):
        refuse(messages.NO_ARGUMENT, part)
    return unit.factor * part.values


def check_result(made: Quantity) -> None:
    """Refuse a sum or a multiple of temperatures, which is none."""
    if made.has_offset and abs(made.weight - 1.0) > SAME:
        refuse(messages.NO_TEMPERATURE, made)
