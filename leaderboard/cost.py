"""The cost of a service: operations, bytes and seconds of a query, from counts and from rates measured on this machine.

Times are processor times of one thread (`time.process_time`), so that other processes matter little. The number of cores is the
seconds of a query times the queries per day, divided by the seconds of a day.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from bench.api import Extractor, ImageAttack, View
from bench.codebook.public import Public
from bench.core.table import Table, build_table
from bench.geometry.nearest_words import WordIndex
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.images import photographs
from bench.mechanisms.subset import draw_word_subsets
from bench.registry import discovery, spec
from bench.tasks.reconstruction import offer_knowledge
from bench.types import Features, Subspaces

COLUMNS = ("who", "step", "operations", "bytes", "core seconds", "TB a day", "cores")
DAY = 86_400  # seconds
POSITION = 8  # bytes of a position, two float32
WORD = 4  # bytes of a word's index
FLOAT = 4  # bytes of a float32
MIN_SECONDS = 0.2  # minimum duration of a measurement


@dataclass(frozen=True, kw_only=True)
class Service:
    """Sizes of a service. The defaults are the paper's if it states them."""

    keypoints: int = 1000  # per image; the paper does not state it
    words: int = 256_000  # |K|
    subset_size: int = 2  # m of LDP-Feat
    dim: int = 4  # of a subspace
    database: int = 256_000  # |W| of affine lifting, which the database attack searches
    references: int = 20  # images that a query is matched with
    length: int = 128  # D, of a descriptor


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Rates of one core of this machine."""

    search: float  # operations per second of the search for the nearest word
    subspaces: float  # operations per second of the search for the words nearest to subspaces
    sets: float  # released sets drawn per second
    extraction: float  # seconds per photograph of 256 x 256
    lifting: float  # seconds per keypoint
    reconstruction: float  # seconds per photograph of 256 x 256


@dataclass(frozen=True, kw_only=True)
class Cost:
    """The cost of one step of a query; None for numbers that do not apply."""

    party: str
    step: str
    operations: float | None = None
    sent: int | None = None  # bytes
    seconds: float | None = None


def measure_rates(service: Service) -> Rates:
    """Measure the rates on a photograph of scikit-image, with one thread. Takes up to a minute.

    Raises
    ------
    UserError
        if this installation lacks its dictionaries or networks.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _measure(service)
    finally:
        torch.set_num_threads(threads)


def _measure(service: Service) -> Rates:
    public = Public()
    rng = np.random.default_rng(0)
    pixels = photographs.read(photographs.list_builtin()[0].path).pixels
    extractor = spec.read("sift", discovery.EXTRACTOR)
    secret = extractor.extract(pixels)
    few = secret.take(np.arange(min(len(secret), 128)))
    known, database = public.dictionary("shipped").first(service.words), public.dictionary("shipped").first(service.database)
    index = WordIndex(known.words)
    assert few.codes is not None
    codes = few.codes
    lifting = spec.read(f"affine:dim={service.dim}", discovery.DEFENSE)
    release = lifting.protect(few, public, rng)
    assert isinstance(release, Subspaces)
    true = rng.integers(len(known), size=10_000)
    size = 2.0 * len(few) * service.length
    return Rates(
        search=size * len(known) / _time(lambda: index.find_nearest(codes)),
        subspaces=size * (service.dim + 1) * len(database) / _time(lambda: find_nearest_to_subspaces(release, database.words, 8)),
        sets=len(true) / _time(lambda: draw_word_subsets(true, len(known), 10.0, service.subset_size, rng)),
        extraction=_time(lambda: extractor.extract(pixels)),
        lifting=_time(lambda: lifting.protect(few, public, rng)) / len(few),
        reconstruction=_time_reconstruction(secret, extractor, public),
    )


def _time_reconstruction(secret: Features, extractor: Extractor, public: Public) -> float:
    attack, defense = spec.read("dia", discovery.ATTACK), spec.read("none", discovery.DEFENSE)
    assert isinstance(attack, ImageAttack)
    release = defense.protect(secret, public, np.random.default_rng(0))
    view = View(release=release, defense=defense, extractor=extractor, knowledge=offer_knowledge(attack, defense, public))
    return _time(lambda: attack.reconstruct(view, np.random.default_rng(0)))


def _time(work: Callable[[], object]) -> float:
    """Return the shortest processor time of several runs, in seconds. The first run may fill caches and does not count."""
    work()
    times: list[float] = []
    while sum(times) < MIN_SECONDS or len(times) < 3:
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return max(min(times), 1e-9)


def list_costs(service: Service, rates: Rates) -> Iterator[Cost]:
    """Yield the steps of one query: on the phone, in transmission, on the server, and of an attacker."""
    n, d, m, dim = service.keypoints, service.length, service.subset_size, service.dim
    search = 2.0 * n * service.words * d
    matching = 2.0 * service.references * n * n * d
    attack = 2.0 * n * (dim + 1) * service.database * d
    yield Cost(party="phone", step="extract SIFT, 256 x 256", seconds=rates.extraction)
    yield Cost(party="phone", step="LDP-Feat: nearest words", operations=search, seconds=search / rates.search)
    yield Cost(party="phone", step="LDP-Feat: draw sets", operations=float(n * m), seconds=n / rates.sets)
    yield Cost(party="phone", step="affine: lift", seconds=n * rates.lifting)
    yield Cost(party="sent", step="undefended, 8 bits a component", sent=n * (POSITION + d))
    yield Cost(party="sent", step="LDP-Feat", sent=n * (POSITION + WORD * m))
    yield Cost(party="sent", step="affine", sent=n * (POSITION + FLOAT * (dim + 1) * d))
    yield Cost(party="server", step="match, undefended", operations=matching, seconds=matching / rates.search)
    yield Cost(
        party="server", step="match, LDP-Feat: each candidate", operations=m * matching, seconds=m * matching / rates.search
    )
    yield Cost(
        party="server", step="match, affine", operations=(dim + 1) * matching, seconds=(dim + 1) * matching / rates.subspaces
    )
    yield Cost(party="attacker", step="affine: words near subspaces", operations=attack, seconds=attack / rates.subspaces)
    yield Cost(party="attacker", step="reconstruct, 256 x 256, eight times", seconds=rates.reconstruction)


def build_cost_table(service: Service, rates: Rates, queries: int) -> Table:
    """Return a table with a row for each step: operations, bytes and seconds per query, then TB and cores of `queries` a day."""
    rows = [
        (
            cost.party,
            cost.step,
            "" if cost.operations is None else f"{cost.operations:.2g}",
            "" if cost.sent is None else f"{cost.sent:,}",
            "" if cost.seconds is None else f"{cost.seconds:.2g}",
            "" if cost.sent is None else f"{cost.sent * queries / 1e12:.3g}",
            "" if cost.seconds is None else f"{cost.seconds * queries / DAY:.2g}",
        )
        for cost in list_costs(service, rates)
    ]
    heading = f"A query of {service.keypoints} keypoints, and {queries:,} a day"
    return build_table(COLUMNS, rows, text=COLUMNS[:2], heading=heading)
