"""Terms as C code, for a filter over a binary and for the wrapper of a refined FMU."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cosim.model.quantities import Parameter
from cosim.terms.language import Direction

Hook = Literal["shape_all", "port_inputs", "added_rates", "readings"]
HOOKS: tuple[Hook, ...] = ("shape_all", "port_inputs", "added_rates", "readings")


@dataclass(frozen=True)
class TermCode:
    """Terms as C functions, with the variables on which they act.

    The parameters of the functions are those of `parameters` in order, then the length of the substep [s]. The
    functions, all `static void`, may use `<math.h>`:

        shape_all(double t, const double *u, const double *m, const double *p, double *out)
        port_inputs(double t, const double *x, const double *u, const double *p, double *out)
        added_rates(double t, const double *x, const double *u, const double *p, double *out)
        readings(double t, const double *y, const double *p, double *out)

    `shape_all` returns the shaped inputs and the memory after the substep. Near 0 as length of the substep, the shaped
    inputs are those at the instant t. `port_inputs` adds forces to the shaped inputs. `added_rates` returns additions
    to the derivatives, `readings` the outputs as delivered. Dormant terms change nothing.

    Attributes:
        source: C text of the functions in `hooks`. Absent functions change nothing.
        parameters: Parameters of all terms; their names are names of variables, e.g. `coulomb_at_v.level`.
        inputs: Continuous real inputs, u.
        states: Variables passed as x: in model exchange all continuous states in FMI order, in co-simulation any real
            variables that can be read between steps.
        outputs: Real outputs, y.
        memory: Number of values in the memory m, zero at the start.
        delay: Name of a parameter [s] by which all inputs are delayed before they are shaped.
        directions: Directions of forces; `library_direction(k, i, t, x, u, p)` in `added_rates` is the rate of state i
            per force along the k-th, from a second instance of the original.
    """

    source: str
    parameters: tuple[Parameter, ...]
    inputs: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    memory: int = 0
    hooks: tuple[Hook, ...] = HOOKS
    delay: str = ""
    directions: tuple[Direction, ...] = ()
