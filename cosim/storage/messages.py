"""Messages of files: archives, tables, YAML, results folders and the cache."""

from cosim.base.messages import Template

# -- archives -------------------------------------------------------------------------------------
DOCTYPE = Template("E-STO-014", "its {name} has a DOCTYPE, which {standard} knows nothing of; take it out")

# -- files ----------------------------------------------------------------------------------------

# -- tables ---------------------------------------------------------------------------------------
ROW_OF_OTHER_LENGTH = Template(
    "E-STO-040", "has {cells}, the header {header}; delete the row, or leave cells empty where nothing was measured"
)
ROW_WITH_DECIMAL_COMMAS = Template(
    "E-STO-041", "has {cells}, the header {header}; is each number cut in two by a decimal comma? Write a point"
)

# -- YAML and JSON --------------------------------------------------------------------------------

# -- results folders ------------------------------------------------------------------------------
