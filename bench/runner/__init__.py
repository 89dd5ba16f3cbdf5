"""Execution of experiments: plans, trials, engines, the attack process, the run directory, records."""
