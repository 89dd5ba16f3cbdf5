"""Everything: all other suites. What they share is done once."""

from bench.runner import suite
from bench.runner.suite import Suite

SUITE = Suite(
    summary="all other suites",
    parts=tuple(part for name in suite.names() if name != "full" for part in suite.find(name).parts),
)
