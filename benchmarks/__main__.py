"""`python -m benchmarks`: one JSON line of ratios."""

from __future__ import annotations

import json

from benchmarks.bench import bench

if __name__ == "__main__":
    print(json.dumps(bench()))
