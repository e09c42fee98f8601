"""Co-simulation of FMUs: scenario, system, master, results, report."""
