"""Linearly implicit Runge-Kutta method for stiff equations: RODAS, order 4, L-stable.

With J = ∂f/∂x at the start of a step of length h, γ = 1/4, and ḟ the partial derivative of f by time:

    (I/(h·γ) − J)·kᵢ = f(t + αᵢ·h, x + Σ aᵢⱼ·kⱼ) + Σ cᵢⱼ·kⱼ/h + γᵢ·h·ḟ        j < i ≤ 6
    x(t + h) = x + Σ a₆ⱼ·kⱼ + k₆

Hairer, Wanner: Solving Ordinary Differential Equations II, section IV.7. `stiff.h` contains the same method in C.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

GAMMA = 0.25
ALPHA = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)
GAMMAS = (0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0)
A = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895, 1.0),
)
C = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.7089089320616),
    (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
)

Vector = Sequence[float]
Derivative = Callable[[Any, Any, Any], Vector]


def step(f: Derivative, J: Sequence[Vector], t: float, x: Vector, u: Vector, h: float) -> tuple[float, ...]:
    """Return x(t + h) by one step of length h, with constant command u.

    Raises:
        ArithmeticError: The linear equations are singular.
    """
    start = tuple(x)
    matrix = [[(i == j) / (h * GAMMA) - slope for j, slope in enumerate(row)] for i, row in enumerate(J)]
    rows = factor(matrix)
    first, middle, last = f(t, start, u), f(t + 0.5 * h, start, u), f(t + h, start, u)
    drift = [(4.0 * (m - a) - (e - a)) / h for a, m, e in zip(first, middle, last, strict=True)]
    ks: list[list[float]] = []
    at = list(start)
    for i in range(6):
        at = [v + sum(a * k[n] for a, k in zip(A[i], ks, strict=True)) for n, v in enumerate(start)]
        rates = f(t + ALPHA[i] * h, tuple(at), u)
        right = [
            r + sum(c * k[n] for c, k in zip(C[i], ks, strict=True)) / h + GAMMAS[i] * h * drift[n]
            for n, r in enumerate(rates)
        ]
        ks.append(solve(matrix, rows, right))
    return tuple([v + k for v, k in zip(at, ks[5], strict=True)])


def factor(a: list[list[float]]) -> list[int]:
    """Replace a matrix by its LU factors; return the order of its rows after pivoting."""
    n = len(a)
    order = list(range(n))
    for c in range(n):
        pivot = max(range(c, n), key=lambda i: abs(a[i][c]))
        a[c], a[pivot] = a[pivot], a[c]
        order[c], order[pivot] = order[pivot], order[c]
        if not abs(a[c][c]) > 0.0:
            raise ArithmeticError("the equations of an implicit integration step are singular")
        for i in range(c + 1, n):
            a[i][c] /= a[c][c]
            for j in range(c + 1, n):
                a[i][j] -= a[i][c] * a[c][j]
    return order


def solve(a: Sequence[Vector], order: Sequence[int], b: Vector) -> list[float]:
    """Return the solution of linear equations with right-hand side b, from the LU factors and row order of `factor`."""
    n = len(a)
    x = [b[k] for k in order]
    for i in range(n):
        for j in range(i):
            x[i] -= a[i][j] * x[j]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            x[i] -= a[i][j] * x[j]
        x[i] /= a[i][i]
    return x
