"""Cache of recovered descriptors of expensive attacks, so that another metric or inverter does not run the attack again.

The key consists of the content of the release, the provenance of other releases, the attack's configuration, and the hash of all
source involved. It contains no part of the secret that was not released. The attack has no access to the key.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.api import Attack, DescriptorAttack, Selection, SelectiveAttack, View
from bench.cache import provenance, store
from bench.core import environment
from bench.core.errors import wrap_plugin_errors
from bench.registry import spec
from bench.task_api import Trial
from bench.threat_model import OtherReleases, PublicAssets, PublicDatabase, RepeatedReleases, ServerMap
from bench.types import Release

KIND = "recovered"
MIN_SECONDS = 1.0  # faster attacks are not cached, since reading the cache takes as long
# The modules that compute the knowledge of an attack.
KNOWLEDGE_MODULES = {
    OtherReleases: "bench.runner.other_releases",
    RepeatedReleases: "bench.runner.trial",
    ServerMap: "bench.localization.server",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class CachedSelection:
    """Recovered descriptors, the notes of the attack, and the seconds saved by the cache."""

    selection: Selection
    notes: tuple[str, ...]
    saved_seconds: float = 0.0


def recover_cached(attack: Attack, trial: Trial, view: View) -> CachedSelection:
    """Run the attack, or return its cached result. In both cases `trial.rng` ends in the same state."""
    if trial.provenance is None:
        return _run_attack(attack, trial, view)
    spent = 0.0

    def compute() -> store.Content:
        nonlocal spent
        start = time.perf_counter()
        result = _run_attack(attack, trial, view)
        spent = time.perf_counter() - start
        meta = {"notes": list(result.notes), "rng": trial.rng.bit_generator.state, "seconds": spent}
        return {"rows": result.selection.rows, "descriptors": result.selection.descriptors}, meta

    arrays, meta = store.fetch(KIND, _key(attack, trial), compute, MIN_SECONDS)
    trial.rng.bit_generator.state = meta["rng"]
    selection = Selection(rows=arrays["rows"], descriptors=arrays["descriptors"])
    return CachedSelection(selection=selection, notes=tuple(meta["notes"]), saved_seconds=meta["seconds"] - spent)


def check_array(array: Any, shape: tuple[int, ...]) -> None:
    """Raise TypeError or ValueError unless `array` is a finite float32 array of that shape."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"returned {type(array).__name__}, expected a NumPy array")
    if array.dtype != np.float32 or array.shape != shape:
        raise ValueError(f"returned {array.dtype} {array.shape}, expected float32 {shape}")
    if not np.isfinite(array).all():
        raise ValueError("returned values that are not finite")


def _run_attack(attack: Attack, trial: Trial, view: View) -> CachedSelection:
    truth = trial.secret.descriptors
    with wrap_plugin_errors(f"plugin {attack.name()}"):
        if isinstance(attack, SelectiveAttack):
            selection = trial.execute(attack.select, view, trial.rng)
            check_array(selection.descriptors, truth[selection.rows].shape)
        elif isinstance(attack, DescriptorAttack):
            descriptors = trial.execute(attack.recover, view, trial.rng)
            check_array(descriptors, truth.shape)
            selection = Selection(rows=np.arange(len(truth)), descriptors=descriptors)
        else:
            raise TypeError(f"{attack.name()} recovers neither descriptors nor images")
    return CachedSelection(selection=selection, notes=tuple(map(str, view.notes)))


def _key(attack: Attack, trial: Trial) -> dict[str, Any]:
    public, extractor = trial.public, trial.extractor
    public_knowledge = {PublicDatabase, PublicAssets} & attack.needs
    modules = {type(plugin).__module__ for plugin in (attack, trial.defense, extractor)}
    modules |= {KNOWLEDGE_MODULES[knowledge] for knowledge in attack.needs if knowledge in KNOWLEDGE_MODULES}
    return {
        "release": _hash_release(trial.release),
        "made from": trial.provenance,
        "attack": spec.to_json_with_digests(attack, public, attack.assets(trial.defense, extractor, public)),
        "rng": trial.rng.bit_generator.state,
        "shipped": [public.digest(asset) for asset in ("shipped", "shipped-public")] if public_knowledge else [],
        "source": provenance.hash_modules(*sorted(modules)),
        "environment": environment.describe_platform(),
    }


def _hash_release(release: Release) -> str:
    """Return the hash of all fields of a release and of its positions."""
    hashed = hashlib.sha256()

    def update(part: Any) -> None:
        hashed.update(type(part).__name__.encode())
        if isinstance(part, np.ndarray):
            hashed.update(f"{part.dtype} {part.shape}".encode())
            hashed.update(np.ascontiguousarray(part).data)
        elif dataclasses.is_dataclass(part):
            for field in dataclasses.fields(part):
                hashed.update(field.name.encode())
                update(getattr(part, field.name))
        else:
            hashed.update(repr(part).encode())

    update(release)
    return hashed.hexdigest()
