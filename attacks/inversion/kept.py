"""Trained networks, found again by what they were made from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attacks.inversion import train, weights
from attacks.inversion.data import Served
from attacks.inversion.encoding import Encoding
from attacks.inversion.train import Training
from bench import cache, environment, provenance, spec
from bench.datasets.photographs import Source
from bench.plugin import Asset, Defense, Extractor
from bench.public import Public

KIND = "networks"


def key(
    defense: Defense,
    served: Served,
    *,
    photographs: Sequence[Source],
    validation: Sequence[Source],
    extractor: Extractor,
    crossfit: Sequence[Asset],
    start: Path | None,
    encoding: Encoding,
    widths: tuple[int, ...],
    training: Training,
) -> dict[str, Any]:
    """All that a network is a function of. Parameters as those of `train`."""
    public = Public()
    return {
        "defense": spec.configuration(defense, public),
        "served": {field: str(setting) for field, setting in served.items()},
        "photographs": [source.content_hash() for source in photographs],
        "validation": [source.content_hash() for source in validation],
        "extractor": spec.written(extractor),
        "crossfit": [public.digest(asset) for asset in crossfit],
        "start": None if start is None else weights.load(start).digest,
        "encoding": encoding,
        "widths": list(widths),
        "training": dataclasses.asdict(training),
        "source": provenance.source(train.__name__, type(defense).__module__, type(extractor).__module__),
        "environment": environment.computing(),
    }


def fetch(made_from: dict[str, Any], out: Path) -> dict[str, Any] | None:
    """Copy the network that was made from that to `out`, unless something is there; its metadata, or None if there is none."""
    if out.exists() or not cache.copy(KIND, made_from, out):
        return None
    return weights.load(out).meta


def keep(made_from: dict[str, Any], out: Path) -> None:
    """Keep a copy of the network in `out`."""
    cache.keep(KIND, made_from, out)
