"""Messages of filter kernels."""

from cosim.base.messages import Template

NO_COMPILED_FILTER = Template("E-KRN-001", "the filter of a refinement is compiled, and {error}; {cure}")
NUMBERS_ONLY = Template("E-KRN-002", "cannot be made of symbols: {error}")
