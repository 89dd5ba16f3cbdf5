"""What attacks recover of descriptors, kept where it was dear: so another metric or inverter does not cost an attack again.

It is kept by the content of the release, by all that other releases are a function of, by the attack's configuration, and by the
source of whatever has a part in it. A key has nothing of the secret but what was released; and an attack is never told of it.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.api import Attack, DescriptorAttack, Selection, SelectiveAttack, Trial, View
from bench.cache import provenance, store
from bench.core import environment
from bench.core.errors import blame
from bench.registry import spec
from bench.types import Knowledge, Release

KIND = "recovered"
WORTH = 1.0  # seconds; what took less is made again as soon as it is read
# What makes that which an attack may know beside the release.
MAKERS = {
    Knowledge.OTHER_RELEASES: "bench.runner.other_releases",
    Knowledge.REPEATED_RELEASES: "bench.runner.trial",
    Knowledge.MAP: "bench.localization.server",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class CachedSelection:
    """What was recovered, what the attack says of it, and the seconds that were spared because it was kept."""

    selection: Selection
    notes: tuple[str, ...]
    saved_seconds: float = 0.0


def recover_cached(attack: Attack, trial: Trial, seen: View) -> CachedSelection:
    """What the attack recovers, now or when it last saw the same. `trial.rng` is left as the attack left it."""
    if trial.provenance is None:
        return _attacked(attack, trial, seen)
    spent = 0.0

    def make() -> store.Content:
        nonlocal spent
        started = time.perf_counter()
        found = _attacked(attack, trial, seen)
        spent = time.perf_counter() - started
        meta = {"notes": list(found.notes), "rng": trial.rng.bit_generator.state, "seconds": spent}
        return {"rows": found.selection.rows, "descriptors": found.selection.descriptors}, meta

    arrays, meta = store.fetch(KIND, _key(attack, trial), make, WORTH)
    trial.rng.bit_generator.state = meta["rng"]
    selection = Selection(rows=arrays["rows"], descriptors=arrays["descriptors"])
    return CachedSelection(selection=selection, notes=tuple(meta["notes"]), saved_seconds=meta["seconds"] - spent)


def check_array(array: Any, shape: tuple[int, ...]) -> None:
    """Raise TypeError or ValueError unless it is a finite float32 array of that shape."""
    if not isinstance(array, np.ndarray):
        raise TypeError(f"returned {type(array).__name__}, expected a NumPy array")
    if array.dtype != np.float32 or array.shape != shape:
        raise ValueError(f"returned {array.dtype} {array.shape}, expected float32 {shape}")
    if not np.isfinite(array).all():
        raise ValueError("returned values that are not finite")


def _attacked(attack: Attack, trial: Trial, seen: View) -> CachedSelection:
    truth = trial.secret.descriptors
    with blame(f"plugin {attack.name()}"):
        if isinstance(attack, SelectiveAttack):
            found = trial.execute(attack.select, seen, trial.rng)
            check_array(found.descriptors, truth[found.rows].shape)
        elif isinstance(attack, DescriptorAttack):
            descriptors = trial.execute(attack.recover, seen, trial.rng)
            check_array(descriptors, truth.shape)
            found = Selection(rows=np.arange(len(truth)), descriptors=descriptors)
        else:
            raise TypeError(f"{attack.name()} recovers neither descriptors nor images")
    return CachedSelection(selection=found, notes=tuple(map(str, seen.notes)))


def _key(attack: Attack, trial: Trial) -> dict[str, Any]:
    public, extractor = trial.public, trial.extractor
    known = {Knowledge.PUBLIC_DATABASE, Knowledge.TRAINING_IMAGES} & attack.needs
    modules = {type(plugin).__module__ for plugin in (attack, trial.defense, extractor)}
    makers = {MAKERS[what] for what in attack.needs if what in MAKERS}
    return {
        "release": _digest(trial.release),
        "made from": trial.provenance,
        "attack": spec.configuration(attack, public, attack.assets(trial.defense, extractor, public)),
        "rng": trial.rng.bit_generator.state,
        "shipped": [public.digest(asset) for asset in ("shipped", "shipped-public")] if known else [],
        "source": provenance.source(*sorted(modules | makers)),
        "environment": environment.computing(),
    }


def _digest(release: Release) -> str:
    """Of all that an attack sees of a release."""
    hashed = hashlib.sha256(type(release).__name__.encode())
    for name, value in sorted(vars(release).items()):
        hashed.update(name.encode())
        if isinstance(value, np.ndarray):
            hashed.update(f"{value.dtype} {value.shape}".encode())
            hashed.update(np.ascontiguousarray(value).data)
        else:
            hashed.update(repr(value).encode())
    return hashed.hexdigest()
