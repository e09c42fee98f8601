"""Files that an FMU carries (FMI-LS-REF): its expected results and experiments, run and compared."""
