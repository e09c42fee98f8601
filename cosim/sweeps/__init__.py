"""Many runs of one scenario: a design of what varies, runs by the thousand, one table, a report."""
