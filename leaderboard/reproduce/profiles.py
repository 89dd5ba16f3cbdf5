"""How large a reproduction is: the sizes of each profile, and the files that it works with."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

from bench.api import Asset, Extractor
from bench.core.errors import unknown_name
from bench.datasets.gallery import Gallery
from bench.datasets.walk import Walk


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Sizes. The code is the same for all profiles."""

    name: str
    photographs: int  # of a table, at most
    builtin: tuple[str, ...] | None  # the built-in photographs to use; all for None
    pictures: int  # photographs of a figure, at most
    scale: float  # of every |K| of a table that varies it; every ε is shifted by its logarithm
    subspaces: int  # that Table S3 lifts, in all
    others: int  # releases of other photographs that Table S4 looks at, at most
    place: Gallery  # that tables of localization are about, unless another is named
    place_scale: float  # as `scale`, for such a table
    trials: float  # of RANSAC, as a share of the paper's
    walk: Walk  # that the table of structure from motion is about, unless another place is named
    walk_scale: float  # as `scale`, for that table
    walk_keypoints: int  # of an image, at most, for that table
    seeds: int  # that it is done with
    # Fields of attacks that are set for want of time, where an attack has them; otherwise attacks are as they were tuned.
    reduced: Mapping[str, int] = field(default_factory=dict)

    @property
    def pictured(self) -> Gallery:
        """The place with as few queries as figures show."""
        return dataclasses.replace(self.place, queries=self.pictures, night=0.0)


# Of the built-in photographs `rocket` has the fewest keypoints.
SMOKE = Profile(
    name="smoke",
    photographs=2,
    builtin=("rocket",),
    pictures=2,
    scale=0.5,
    subspaces=40,
    others=8,
    place=Gallery(views=12, queries=6, width=320, height=240, rooms=1, detail=0.5),
    place_scale=1 / 512,
    trials=1 / 10_000,
    walk=Walk(views=4, others=8, steps=60, width=320, height=240, detail=0.3),
    walk_scale=1 / 256,
    walk_keypoints=1000,
    seeds=1,
    reduced={"others": 8},
)
CPU = Profile(
    name="cpu",
    photographs=16,
    builtin=None,
    pictures=3,
    scale=0.5,
    subspaces=20_000,
    others=1600,
    place=Gallery(),
    place_scale=1 / 32,
    trials=0.003,
    walk=Walk(),
    walk_scale=1 / 2,
    walk_keypoints=2000,
    seeds=6,
)
PAPER = Profile(
    name="paper",
    photographs=1_000_000,
    builtin=None,
    pictures=10,
    scale=1.0,
    subspaces=100_000,
    others=1600,
    place=Gallery(),
    place_scale=1.0,
    trials=1.0,
    walk=Walk(views=128, others=212),
    walk_scale=1.0,
    walk_keypoints=8192,
    seeds=6,
)
PROFILES = {profile.name: profile for profile in (SMOKE, CPU, PAPER)}


@dataclass(frozen=True, kw_only=True)
class Materials:
    """Dictionaries, databases and networks: those of this distribution, or a user's own."""

    dictionary: Asset = Asset("shipped")  # K of LDP-Feat; a smaller |K| is its first words
    database: Asset = Asset("shipped")  # W of affine lifting
    public_database: Asset = Asset("shipped-public")  # Z
    raw_network: Asset = Asset("shipped")
    affine_network: Asset = Asset("shipped")
    ldp_network: Asset = Asset("shipped")


@dataclass(frozen=True, kw_only=True)
class Setting:
    """All that the rows of a table depend on."""

    profile: Profile
    materials: Materials
    extractor: Extractor
    photographs: int  # that there are
    seed: int = 0


def profile(name: str) -> Profile:
    """The profile of that name.

    Raises
    ------
    UserError
        if there is none.
    """
    if name not in PROFILES:
        raise unknown_name("profile", name, PROFILES)
    return PROFILES[name]
