"""Knowledge of an attacker besides the release: one class for each kind.

An attack lists the classes in its `needs`. `bench run` creates the objects, and `View.know(Class)` returns one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from bench.types import Indices, Release, Words

if TYPE_CHECKING:
    from bench.codebook.public import Public
    from bench.localization.server import Server


class Knowledge:
    """Base class of all kinds of knowledge."""

    description: ClassVar[str]  # for messages


@dataclass(frozen=True, kw_only=True, eq=False)
class DefenseDatabase(Knowledge):
    """The database W of a lifting."""

    description = "the database W that lifting drew its adversarial descriptors from"

    words: Words  # (W, D)


@dataclass(frozen=True, kw_only=True, eq=False)
class PublicDatabase(Knowledge):
    """A database Z of the attacker's own."""

    description = "a database Z of the attacker's own, from other photographs"

    words: Words  # (Z, D)


@dataclass(frozen=True, kw_only=True, eq=False)
class OtherReleases(Knowledge):
    """Releases of other photographs, made by the same defense with the same database."""

    description = "other releases made with the same database"

    draw: Callable[[int], Iterator[Release]]  # count -> the first `count` releases


@dataclass(frozen=True, kw_only=True, eq=False)
class RepeatedReleases(Knowledge):
    """Further releases of the same photograph. `Attack.repeats` gives their number."""

    description = "further releases of the same photograph"

    releases: tuple[Release, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class PublicAssets(Knowledge):
    """Public dictionaries. An attack with a network trained on public photographs declares this class, too."""

    description = "networks trained on public photographs, and public dictionaries"

    assets: Public


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueWords(Knowledge):
    """The position of the true word in each released set. It is part of the secret: no attacker has it.

    An attack that needs it is an oracle: a ceiling for attacks that select words, and no evidence of leakage.
    """

    description = "the true words, which no attacker knows"

    candidates: Indices  # (N,) index of the true word among the candidates; m if it is none of them


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueNeighbours(Knowledge):
    """The order of the other keypoints by their distance. It is part of the secret: no attacker has it.

    An attack that needs it is an oracle: a ceiling for attacks that predict neighbours, and no evidence of leakage.
    """

    description = "the true neighbours, which no attacker knows"

    order: Indices  # (N, N − 1) rows, nearest first


@dataclass(frozen=True, kw_only=True, eq=False)
class ServerMap(Knowledge):
    """The server of a localization service, with its map."""

    description = "the server's map"

    server: Server
