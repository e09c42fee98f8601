"""Native code: C common to all models, compiler and cache."""
