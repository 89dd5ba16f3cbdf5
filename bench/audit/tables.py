"""An audit as people read it."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from bench.audit.auditor import Audit
from bench.audit.findings import CERTAINTY, CONFIDENCE


def report(found: Audit, defense: str) -> Iterator[Text | Table]:
    """The findings and the verdict."""
    unit = " per unit of distance" if found.by_distance else ""
    table = Table(
        title=Text(f"{defense} claims ε = {found.claimed:g}{unit}"),
        caption=Text("\n".join(found.notes)),
        title_justify="left",
        caption_justify="left",
    )
    for column in ("events", "the most telling"):
        table.add_column(column, overflow="fold")
    for column in ("rate", "rate for the other", "trials of each", f"ε{unit} at least ({CONFIDENCE:.0%})"):
        table.add_column(column, justify="right")
    for finding in found.findings:
        one, other = finding.rates
        table.add_row(
            Text(finding.family), Text(finding.event), f"{one:.5g}", f"{other:.5g}", str(finding.trials), f"{finding.epsilon:.4f}"
        )
    yield table
    if found.enumeration is not None:
        least, most = found.enumeration.low, found.enumeration.high
        power = "e^(ε d)" if found.by_distance else "e^ε"
        yield Text(
            "all outputs enumerated: the greatest ratio of two words' probabilities is "
            f"{power} for ε from {least:.15g} to {most:.15g}"
        )
    bound = f"ε is at least {found.strongest.epsilon:.4f} with confidence {CONFIDENCE:.0%}, by {found.strongest.family}"
    yield Text(f"{bound}: {_judgement(found)}")


def _judgement(found: Audit) -> str:
    if found.verdict == "tight":
        return "tight (consistent with the claim, and near to it)"
    if found.verdict == "consistent":
        return "consistent with the claim"
    guilty = [finding.family for finding in found.findings if finding.certain > found.claimed]
    if found.enumeration is not None and found.enumeration.exceeds:
        guilty.append("enumeration")
    return f"violated, beyond doubt of {1 - CERTAINTY:.0e} (by {', '.join(guilty)})"
