"""Filter kernels, which filter or simulate a log; their interface consists of arrays."""
