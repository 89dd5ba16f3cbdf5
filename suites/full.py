"""Everything: all other suites. What they share is done once."""

from bench import suite
from bench.suite import Suite

SUITE = Suite(
    summary="all other suites",
    parts=tuple(part for name in suite.names() if name != "full" for part in suite.find(name).parts),
)
