"""Messages of filter kernels."""

from cosim.base.messages import Template

NO_COMPILED_FILTER = Template("E-KRN-001", "refine compiles its filter with a C compiler, but {error}; {cure}")
NUMBERS_ONLY = Template(
    "E-KRN-002", "this line works on numbers only, and refine replaces numbers by symbols to compile it: {error}"
)
NO_CONSTANTS = Template(
    "E-KRN-003",
    "{names} cannot be estimated per log: the library of an FMU takes parameters before its initialization only; "
    "leave out per_log",
)
