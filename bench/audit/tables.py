"""An audit as terminal output."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from bench.audit.auditor import Audit
from bench.audit.findings import CERTAINTY, CONFIDENCE


def report(audit: Audit, defense: str) -> Iterator[Text | Table]:
    """Yield the findings and the verdict."""
    unit = " per unit of distance" if audit.by_distance else ""
    table = Table(
        title=Text(f"{defense} claims ε = {audit.claimed:g}{unit}"),
        caption=Text("\n".join(audit.notes)),
        title_justify="left",
        caption_justify="left",
    )
    for column in ("events", "most informative event"):
        table.add_column(column, overflow="fold")
    for column in ("rate", "rate of the other", "trials each", f"ε{unit} at least ({CONFIDENCE:.0%})"):
        table.add_column(column, justify="right")
    for finding in audit.findings:
        one, other = finding.rates
        table.add_row(
            Text(finding.family), Text(finding.event), f"{one:.5g}", f"{other:.5g}", str(finding.trials), f"{finding.epsilon:.4f}"
        )
    yield table
    if audit.enumeration is not None:
        least, most = audit.enumeration.low, audit.enumeration.high
        power = "e^(ε d)" if audit.by_distance else "e^ε"
        yield Text(
            "all outputs enumerated: the greatest probability ratio of two words is "
            f"{power} for ε from {least:.15g} to {most:.15g}"
        )
    bound = f"ε is at least {audit.strongest.epsilon:.4f} with confidence {CONFIDENCE:.0%}, by {audit.strongest.family}"
    yield Text(f"{bound}: {_describe_verdict(audit)}")


def _describe_verdict(audit: Audit) -> str:
    if audit.verdict == "tight":
        return "tight (consistent with the claim, and close to it)"
    if audit.verdict == "consistent":
        return "consistent with the claim"
    families = [finding.family for finding in audit.findings if finding.certain_epsilon > audit.claimed]
    if audit.enumeration is not None and audit.enumeration.exceeds:
        families.append("enumeration")
    return f"violated, with error probability {1 - CERTAINTY:.0e} (by {', '.join(families)})"
