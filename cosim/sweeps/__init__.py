"""Many runs of a scenario: design of experiments, execution, table and report."""
