"""Profiles, which are the sizes of a reproduction, and the files that it uses."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import get_args

from bench.api import Extractor
from bench.core.errors import unknown_name
from bench.datasets.gallery import Gallery
from bench.datasets.hard_night import HardNight, select_shared
from bench.datasets.walk import Walk
from bench.settings import Asset
from bench.sfm.incremental_mapping import Mapper
from bench.tasks.structure import Matching


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Sizes of a reproduction. The code is the same for all profiles."""

    name: str
    photographs: int  # maximum number per table
    builtin: tuple[str, ...] | None  # names of the built-in photographs to use; None: all
    figure_photographs: int  # maximum number per figure
    scale: float  # factor of each |K| of a table that varies it; its logarithm is added to each ε
    subspaces: int  # total number for Table S3
    other_releases: int  # maximum number for Table S4
    gallery: Gallery  # of figures of queries; by day, also of the localization tables
    gallery_scale: float  # `scale` of these tables
    trials: float  # RANSAC's trials, as a fraction of the paper's
    walk: Walk  # default dataset of the structure-from-motion table
    walk_scale: float  # `scale` of that table
    walk_keypoints: int  # maximum number per image for that table
    seeds: int  # number of seeds of that table
    walk_variants: tuple[tuple[Mapper, Matching], ...] = (("global", "unique-words"),)  # of that table; claims rest on the first
    walk_max_matched: int = 0  # largest m of that table whose words are matched by descriptors
    # Values of fields that save time, for attacks with these fields. All other fields have their tuned defaults.
    attack_overrides: Mapping[str, int] = field(default_factory=dict)

    @property
    def hard_night(self) -> HardNight:
        """The default dataset of the localization tables: the gallery with a night that is hard to localize."""
        return HardNight(**select_shared(self.gallery))

    @property
    def figure_gallery(self) -> Gallery:
        """The gallery, with only the queries that figures show."""
        return dataclasses.replace(self.gallery, queries=self.figure_photographs, night=0.0)


# `rocket` is the built-in photograph with the fewest keypoints.
SMOKE = Profile(
    name="smoke",
    photographs=2,
    builtin=("rocket",),
    figure_photographs=2,
    scale=0.5,
    subspaces=40,
    other_releases=8,
    gallery=Gallery(views=12, queries=6, width=320, height=240, rooms=1, detail=0.5),
    gallery_scale=1 / 512,
    trials=1 / 10_000,
    walk=Walk(views=4, others=8, steps=60, width=320, height=240, detail=0.3),
    walk_scale=1 / 256,
    walk_keypoints=1000,
    seeds=1,
    walk_variants=(("global", "unique-words"), ("incremental", "descriptors")),
    walk_max_matched=4,
    attack_overrides={"others": 8},
)
CPU = Profile(
    name="cpu",
    photographs=100,
    builtin=None,
    figure_photographs=3,
    scale=0.5,
    subspaces=20_000,
    other_releases=1600,
    gallery=Gallery(),
    gallery_scale=1 / 32,
    trials=0.003,
    walk=Walk(),
    walk_scale=1 / 2,
    walk_keypoints=2000,
    seeds=6,
)
# Table S2 with COLMAP's default limit of keypoints, both mappers, and matches that need not be unique.
DENSE = dataclasses.replace(
    CPU,
    name="dense",
    walk_keypoints=8192,
    walk_variants=tuple(itertools.product(get_args(Mapper), get_args(Matching))),
    walk_max_matched=4,
)
PAPER = Profile(
    name="paper",
    photographs=1_000_000,
    builtin=None,
    figure_photographs=10,
    scale=1.0,
    subspaces=100_000,
    other_releases=1600,
    gallery=Gallery(),
    gallery_scale=1.0,
    trials=1.0,
    walk=Walk(views=128, others=212),
    walk_scale=1.0,
    walk_keypoints=8192,
    seeds=6,
    walk_variants=DENSE.walk_variants,
    walk_max_matched=64,
)
PROFILES = {profile.name: profile for profile in (SMOKE, CPU, DENSE, PAPER)}


@dataclass(frozen=True, kw_only=True)
class Materials:
    """Dictionaries, databases and networks: the shipped ones, or those of a user."""

    dictionary: Asset = Asset("shipped")  # K of LDP-Feat; a smaller |K| is its first words
    database: Asset = Asset("shipped")  # W of affine lifting
    public_database: Asset = Asset("shipped-public")  # Z
    raw_network: Asset = Asset("shipped")
    affine_network: Asset = Asset("shipped")
    ldp_network: Asset = Asset("shipped")
    # Networks with the paper's input, of `bench train --encoding released`: stacked origin and basis, or stacked words.
    as_printed_affine: Asset | None = None
    as_printed_ldp: Asset | None = None


@dataclass(frozen=True, kw_only=True)
class Setting:
    """The settings that the rows of a table depend on."""

    profile: Profile
    materials: Materials
    extractor: Extractor
    photographs: int  # number of photographs
    seed: int = 0


def find_profile(name: str) -> Profile:
    """Return the profile of that name.

    Raises
    ------
    UserError
        if there is none.
    """
    if name not in PROFILES:
        raise unknown_name("profile", name, PROFILES)
    return PROFILES[name]
