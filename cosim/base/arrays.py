"""The one type of all numbers that come in rows and columns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # of any shape; a docstring says which
Rows = NDArray[np.intp]  # places in one
Flags = NDArray[np.bool_]  # yes or no at each place

# Beyond what a double holds a result is infinite or not a number, which the caller judges: nothing for numpy to print.
far_beyond = np.errstate(over="ignore", invalid="ignore")
