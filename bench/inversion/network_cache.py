"""Trained networks, found again by what they were made from."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from bench.cache import provenance, store
from bench.codebook.public import Public
from bench.core import environment
from bench.inversion import train, weights
from bench.inversion.plan import Plan
from bench.registry import spec

KIND = "networks"


def key(plan: Plan) -> dict[str, Any]:
    """All that the network is a function of."""
    public = Public()
    return {
        "defense": spec.configuration(plan.defense, public),
        "served": {field: str(setting) for field, setting in plan.served.items()},
        "photographs": [source.content_hash() for source in plan.photographs],
        "validation": [source.content_hash() for source in plan.validation],
        "extractor": spec.written(plan.extractor),
        "crossfit": [public.digest(asset) for asset in plan.crossfit],
        "start": None if plan.start is None else weights.load(plan.start).digest,
        "encoding": plan.encoding,
        "widths": list(plan.widths),
        "training": dataclasses.asdict(plan.training),
        "source": provenance.source(train.__name__, type(plan.defense).__module__, type(plan.extractor).__module__),
        "environment": environment.computing(),
    }


def fetch(made_from: dict[str, Any], out: Path) -> dict[str, Any] | None:
    """Copy the network that was made from that to `out`, unless something is there; its metadata, or None if there is none."""
    if out.exists() or not store.copy(KIND, made_from, out):
        return None
    return weights.load(out).meta


def keep(made_from: dict[str, Any], out: Path) -> None:
    """Keep a copy of the network in `out`."""
    store.keep(KIND, made_from, out)
