"""Types of plugin fields, and sets of their values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


class Asset(str):
    """Type of a field that names a file: `shipped`, or a path. Records hold the digest of the content, not the name."""


@dataclass(frozen=True)
class Between:
    """All real values from `low` to `high`."""

    low: float
    high: float

    def sample(self, rng: np.random.Generator) -> float:
        """Draw a value, uniformly."""
        return float(rng.uniform(self.low, self.high))

    def __contains__(self, value: object) -> bool:
        return isinstance(value, (int, float)) and self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class OneOf:
    """The listed values."""

    values: tuple[float | str, ...]

    def sample(self, rng: np.random.Generator) -> float | str:
        """Draw a value, uniformly."""
        return self.values[rng.integers(len(self.values))]

    def __contains__(self, value: object) -> bool:
        return value in self.values

    def __str__(self) -> str:
        return ", ".join(map(str, self.values))
