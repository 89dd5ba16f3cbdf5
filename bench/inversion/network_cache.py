"""Cache of trained networks, by the inputs of their training."""

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
from bench.registry.composed import list_parts

KIND = "networks"


def build_key(plan: Plan) -> dict[str, Any]:
    """Return all inputs of the training."""
    public = Public()
    return {
        "targets": [
            {
                "defense": spec.to_json_with_digests(target.defense, public),
                "supported": {field: str(setting) for field, setting in target.supported_settings.items()},
            }
            for target in plan.targets
        ],
        "photographs": [source.content_hash() for source in plan.photographs],
        "validation": [source.content_hash() for source in plan.validation],
        "extractor": spec.to_json(plan.extractor),
        "crossfit": [public.digest(asset) for asset in plan.crossfit],
        "start": None if plan.initial_checkpoint is None else weights.load(plan.initial_checkpoint).digest,
        "encoding": plan.encoding,
        "model": plan.model,
        "drafts": None if plan.drafts is None else train.find_drafts(plan.targets, plan.drafts),
        "keypoints": plan.keypoints,
        "widths": list(plan.widths),
        "training": dataclasses.asdict(plan.training),
        "source": provenance.hash_modules(
            train.__name__,
            *sorted({type(part).__module__ for target in plan.targets for part in list_parts(target.defense)}),
            type(plan.extractor).__module__,
            *([type(plan.drafts).__module__] if plan.drafts else []),
        ),
        "environment": environment.describe_platform(),
    }


def fetch(key: dict[str, Any], out: Path) -> dict[str, Any] | None:
    """Copy the cached network to `out`, and return its metadata; None if nothing is cached or `out` exists already."""
    if out.exists() or not store.copy_file(KIND, key, out):
        return None
    return weights.load(out).meta


def save(key: dict[str, Any], out: Path) -> None:
    """Add the network in `out` to the cache."""
    store.store_file(KIND, key, out)
