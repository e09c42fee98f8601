"""The array types of the package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # of any shape; docstrings name the shape
Rows = NDArray[np.intp]  # indices into an array
Flags = NDArray[np.bool_]  # a truth value per element

# Results beyond the range of a double become infinite or NaN. Callers judge them, so numpy need not warn.
far_beyond = np.errstate(over="ignore", invalid="ignore")
