"""All other suites. Experiments that suites share run once."""

from bench.runner import suite
from bench.runner.suite import Suite

SUITE = Suite(
    summary="all other suites",
    parts=tuple(part for name in suite.list_suites() if name != "full" for part in suite.find(name).parts),
)
