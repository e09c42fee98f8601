"""Native FMUs: C code common to all models, compilers, and a cache of libraries."""
