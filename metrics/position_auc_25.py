"""Accuracy of recovered positions, up to 25 pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from bench.positions.accuracy import PositionAUC


@dataclass(frozen=True, kw_only=True)
class PositionAUC25(PositionAUC):
    """Area under the curve of the fraction of keypoints recovered within a distance, up to 25 pixels."""

    reach: ClassVar[float] = 25.0


PLUGIN = PositionAUC25
