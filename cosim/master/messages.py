"""Messages of stepping: initialization, early ends, observers, disk space."""

from cosim.base.messages import Template

NOT_SETTLED = Template(
    "E-MAS-001",
    "values still change after {count} exchanges: an algebraic loop that exchanging values does not settle; an FMU "
    "without direct feedthrough in the loop breaks it",
)
STATE_NOT_RESTORED = Template(
    "E-MAS-002",
    "its outputs differ after a saved state is restored; use an FMU that restores its state, or one that does not "
    "declare that it can",
)
OBSERVER_FAILED = Template("E-MAS-003", "{error}: {reason}")
UNEXPECTED_ERROR = Template("E-MAS-004", "{call}: {error}: {reason} (--in-process shows where)")
DISK_FULL = Template("E-MAS-005", "the disk is full: it has room for {count} of {rows} rows while the run lasts")
END_REQUESTED = Template("N-MAS-006", "it asked for the end")
ENDED_EARLY = Template("N-MAS-007", "{component} ended the simulation at t = {time:.6g} s: {reason}")
