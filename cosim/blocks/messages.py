"""Messages of components: FMUs, sources and faults."""

from cosim.base.messages import Template

# -- reading an FMU --------------------------------------------------------------------------------


# -- loading its library ---------------------------------------------------------------------------


# -- compiling its sources -------------------------------------------------------------------------


# -- calling it ------------------------------------------------------------------------------------


# -- integrating its derivatives -------------------------------------------------------------------


# -- event mode and clocks ---------------------------------------------------------------------------


# -- FMUs on other machines ----------------------------------------------------------------------------

SERVER_SILENT = Template("E-BLK-080", "the server at {at} has not answered for {wait:g} s")
CONNECTION_LOST = Template("E-BLK-082", "the connection to {at} is lost: {reason}")

# -- code of one name ------------------------------------------------------------------------------------
