"""Two defenses together: one hides the positions, the other the descriptors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from bench.api import Defense, Privacy
from bench.core.errors import UserError
from bench.types import Descriptors, Features, Release

if TYPE_CHECKING:
    from bench.codebook.public import Public

# Declarations of the defense of descriptors that hold for both together.
INHERITED = ("releases", "supported_settings", "dictionary_field", "word_count_field", "noisy")


@dataclass(frozen=True, kw_only=True)
class Composed(Defense):
    """Releases the positions of one defense with the descriptors of another."""

    geometry: Defense
    descriptors: Defense

    releases = Release

    def __post_init__(self) -> None:
        for name in INHERITED:
            object.__setattr__(self, name, getattr(self.descriptors, name))
        for field in (*self.supported_settings, self.dictionary_field, self.word_count_field):
            if field is not None:
                object.__setattr__(self, field, getattr(self.descriptors, field))
        object.__setattr__(self, "positions", self.geometry.positions)

    @property
    def parts(self) -> tuple[Defense, Defense]:
        """The defense of positions, and that of descriptors."""
        return self.geometry, self.descriptors

    def name(self) -> str:  # type: ignore[override]  # depends on the parts
        """Return the names of the parts, such as `lines+ldp`."""
        return "+".join(part.name() for part in self.parts)

    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Release:
        # Descriptors first: so the answers of a memoized defense are those that it gives alone.
        release = self.descriptors.protect(secret, public, rng)
        return dataclasses.replace(release, positions=self.geometry.protect(secret, public, rng).positions)

    def privacy(self, public: Public) -> Privacy:
        """Return the guarantee for one descriptor. The random positions are independent of descriptors, so they spend no ε."""
        return self.descriptors.privacy(public)

    def distance(self, secret: Features, public: Public, one: int, other: int) -> Fraction:
        return self.descriptors.distance(secret, public, one, other)

    def is_memoized(self) -> bool:
        return self.descriptors.is_memoized()


def compose(defenses: Sequence[Defense]) -> Composed:
    """Return two defenses together, in any order.

    Raises
    ------
    UserError
        unless one hides positions and the other does not.
    """
    names = "+".join(defense.name() for defense in defenses)
    geometry = [defense for defense in defenses if hides_positions_alone(defense)]
    others = [defense for defense in defenses if not hides_positions_alone(defense)]
    for kind, same in (("positions", geometry), ("descriptors", others)):
        if len(same) > 1:
            doubled = " and ".join(defense.name() for defense in same)
            raise UserError(f"{names}: {doubled} both release {kind}; compose one defense of positions and one of descriptors")
    return Composed(geometry=geometry[0], descriptors=others[0])


def hides_positions_alone(defense: Defense) -> bool:
    """Return whether a defense hides positions and releases descriptors unchanged, so that it can be composed with another."""
    return defense.hides_positions() and issubclass(defense.releases, Descriptors)


def configure(defense: Defense, settings: Mapping[str, object]) -> Defense:
    """Return the defense with other settings; those of a composed one are settings of its defense of descriptors."""
    if isinstance(defense, Composed):
        return dataclasses.replace(defense, descriptors=configure(defense.descriptors, settings))
    return dataclasses.replace(defense, **settings)  # type: ignore[type-var]  # plugins are dataclasses


def list_parts(defense: Defense) -> tuple[Defense, ...]:
    """Return the parts of a composed defense, or the defense itself."""
    return defense.parts if isinstance(defense, Composed) else (defense,)
