"""The pictures above a table: one photograph, and its reconstruction by the strongest attack on each defense."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from leaderboard.comparison import ComparisonGroup
from leaderboard.measures import PRIVACY
from leaderboard.site.experiments import Picture, View, label_sample


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """The picture of one defense, or the reason why there is none."""

    view: View
    picture: Picture | None
    reason: str


@dataclass(frozen=True, kw_only=True)
class Overview:
    """The reconstructions of one sample, in the order of the table."""

    sample: str
    photograph: str | None  # path relative to the page
    reconstructions: tuple[Reconstruction, ...]


def build_overview(group: ComparisonGroup, views: Sequence[View]) -> Overview | None:
    """Return the pictures above the table of a group; None if no experiment of the group has a picture.

    The sample is the one with reconstructions of the most ranked defenses. Ties are broken by the number of rows that have a
    picture of the sample, then by its name.
    """
    samples = sorted({picture.sample for view in views for picture in view.pictures})
    if not samples:
        return None
    sample = max(samples, key=lambda sample: _count_pictures(views, sample))
    photographs = (picture.files.original for view in views if (picture := view.find_picture(sample)))
    return Overview(
        sample=sample,
        photograph=next(filter(None, photographs), None),
        reconstructions=tuple(
            Reconstruction(view=view, picture=view.find_picture(sample), reason=_explain_missing(group, view, sample))
            for view in views
            if view.row.strongest
        ),
    )


def _count_pictures(views: Sequence[View], sample: str) -> tuple[int, int]:
    """Return the numbers of ranked defenses and of rows that have a picture of the sample."""
    rows = [view.row for view in views if view.find_picture(sample)]
    return sum(row.strongest and row.values["rank"] is not None for row in rows), len(rows)


def _explain_missing(group: ComparisonGroup, view: View, sample: str) -> str:
    """Return why an experiment has no picture of the sample; "" if it has one."""
    if view.find_picture(sample):
        return ""
    if view.experiment.reason:
        return f"n/a: {view.experiment.reason}"
    records = [located.record for located in view.experiment.records if label_sample(group, located.record) == sample]
    if not records:
        return "not done"
    if records[0]["status"] == "failed":
        return f"failed: {records[0]['reason']}"
    if records[0]["metrics"].get(PRIVACY) is None:
        return "This attack returns no image."
    return "The results folder has no reconstruction of this sample."
