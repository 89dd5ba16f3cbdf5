"""Output of an audit on the terminal."""

from __future__ import annotations

from collections.abc import Iterator

from bench.audit.auditor import Audit
from bench.audit.findings import CERTAINTY, CONFIDENCE
from bench.core.table import Table, build_table


def report(audit: Audit, defense: str) -> Iterator[Table | str]:
    """Yield the findings and the verdict."""
    unit = " per unit of distance" if audit.by_distance else ""
    text = ("events", "most informative event")
    columns = (*text, "rate", "rate of the other", "trials each", f"ε{unit} at least ({CONFIDENCE:.0%})")
    rows = [
        (finding.family, finding.event, *(f"{rate:.5g}" for rate in finding.rates), str(finding.trials), f"{finding.epsilon:.4f}")
        for finding in audit.findings
    ]
    yield build_table(columns, rows, text=text, heading=f"{defense} claims ε = {audit.claimed:g}{unit}", remarks=audit.notes)
    if audit.enumeration is not None:
        least, most = audit.enumeration.low, audit.enumeration.high
        power = "e^(ε d)" if audit.by_distance else "e^ε"
        yield (
            "all outputs enumerated: the greatest probability ratio of two words is "
            f"{power} for ε from {least:.15g} to {most:.15g}"
        )
    bound = f"ε is at least {audit.strongest.epsilon:.4f} with confidence {CONFIDENCE:.0%}, by {audit.strongest.family}"
    yield f"{bound}: {_describe_verdict(audit)}"


def _describe_verdict(audit: Audit) -> str:
    if audit.verdict == "tight":
        return "tight (consistent with the claim, and close to it)"
    if audit.verdict == "consistent":
        return "consistent with the claim"
    families = [finding.family for finding in audit.findings if finding.certain_epsilon > audit.claimed]
    if audit.enumeration is not None and audit.enumeration.exceeds:
        families.append("enumeration")
    return f"violated, with error probability {1 - CERTAINTY:.0e} (by {', '.join(families)})"
