"""Runs experiments: plan, trial, execute, engines, the attack process, the run directory, records."""
