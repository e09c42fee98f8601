"""Filter kernels over logs, with arrays as interface."""
