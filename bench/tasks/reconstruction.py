"""Reconstruction: how much of the photograph an attacker paints from a release, and how near he comes to its descriptors."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench import fields, recovery, registry, spec, units
from bench.errors import UnitError, UserError, blamed
from bench.plugin import (
    Attack,
    Dataset,
    Defense,
    DescriptorAttack,
    Extractor,
    ImageAttack,
    Metric,
    Outcome,
    Task,
    Trial,
    View,
)
from bench.public import Public
from bench.types import Descriptors, Floats, Knowledge
from bench.units import Collection, Images

RELEASES = {Knowledge.OTHER_RELEASES, Knowledge.REPEATED_RELEASES}  # which every defense can make


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Task):
    """Compares the attacker's image with the photograph, and his descriptors with the true ones.

    Where an attack recovers descriptors, the `inverter` paints them: the network for raw descriptors.
    """

    attacked = True

    inverter: str = "dia"  # an attack that reconstructs images

    def collection(self, images: Images, dataset: Dataset | None) -> Collection:
        if dataset is None:
            return units.of_photographs(images)
        if images is not None:
            raise UserError("reconstruction takes photographs or the queries of a dataset, not both")
        return units.of_queries(dataset)

    def inapplicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        if attack is None:
            return "reconstruction needs an attack"
        missing = attack.needs - offered(attack, defense, public).keys() - RELEASES
        if missing:
            wanted = " and ".join(sorted(need.value for need in missing))
            return f"{attack.name()} needs {wanted}; there is none for {defense.name()}"
        return attack.inapplicable(defense, extractor, public)

    def resolved(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        if attack is None:
            return {}
        for what, load in offered(attack, defense, public).items():
            if what in attack.needs:
                load()
        digests = dict(attack.assets(defense, extractor, public))
        if not isinstance(attack, DescriptorAttack):
            return digests
        inverter, undefended, reason = self._inverter(extractor, public)
        if reason is not None:
            return digests | {"inversion": None}
        return digests | {"inversion": spec.configuration(inverter, public, inverter.assets(undefended, extractor, public))}

    def judge(self, trial: Trial) -> Outcome:
        attack = trial.attack
        if isinstance(attack, ImageAttack):
            return compared(trial, None, reconstructed(attack, view(trial), trial.rng))
        if not isinstance(attack, DescriptorAttack):
            raise UnitError("reconstruction needs an attack")
        found = recovery.recovered(attack, trial, view(trial))
        inverter, undefended, reason = self._inverter(trial.extractor, trial.public)
        if reason is not None:
            outcome = compared(trial, found.descriptors, None, (*found.notes, f"no image: {reason}"))
            return dataclasses.replace(outcome, spared=found.spared)
        release = Descriptors(keypoints=trial.release.keypoints, size=trial.release.size, descriptors=found.descriptors)
        seen = view(dataclasses.replace(trial.released(release), attack=inverter, defense=undefended))
        outcome = compared(trial, found.descriptors, reconstructed(inverter, seen, trial.rng), found.notes)
        return dataclasses.replace(outcome, spared=found.spared)

    def _inverter(self, extractor: Extractor, public: Public) -> tuple[ImageAttack, Defense, str | None]:
        """The attack that paints descriptors, the defense that it was made for, and why it cannot be used, if it cannot."""
        inverter = spec.read(self.inverter, registry.ATTACK)
        if not isinstance(inverter, ImageAttack):
            raise UserError(f"reconstruction: inverter must reconstruct images, and {inverter.name()} does not")
        undefended = registry.lookup(registry.DEFENSE, "none")()
        return inverter, undefended, inverter.inapplicable(undefended, extractor, public)


def offered(attack: Attack, defense: Defense, public: Public) -> dict[Knowledge, Callable[[], Any]]:
    """What there is to know beside releases made by that defense."""
    databases = fields.asset_fields(defense)
    own = fields.asset_fields(attack).get("database", "shipped-public")
    offers: dict[Knowledge, Callable[[], Any]] = {
        Knowledge.PUBLIC_DATABASE: lambda: public.dictionary(own),
        Knowledge.TRAINING_IMAGES: lambda: public,
    }
    if "database" in databases:
        offers[Knowledge.DATABASE] = lambda: public.dictionary(databases["database"])
    return offers


def view(trial: Trial) -> View:
    """All that the attack gets: copies of what was released, and of the rest only what it declared to need."""
    attack = trial.attack
    assert attack is not None
    offers = offered(attack, trial.defense, trial.public) | {
        Knowledge.OTHER_RELEASES: lambda: lambda count: map(copy.deepcopy, trial.others(count)),
        Knowledge.REPEATED_RELEASES: lambda: copy.deepcopy(list(trial.repeats)),
    }
    return View(
        release=copy.deepcopy(trial.release),  # whatever the attack does to it, the next attack sees what was released
        defense=trial.defense,
        extractor=trial.extractor,
        knowledge={what: load for what, load in offers.items() if what in attack.needs},
    )


def reconstructed(attack: ImageAttack, seen: View, rng: np.random.Generator) -> Floats:
    """The attacker's image. -> (H, W, 3)"""
    with blamed(f"plugin {attack.name()}"):
        image = attack.reconstruct(seen, rng)
        width, height = seen.release.size
        recovery.expect(image, (height, width, 3))
        if image.min() < 0 or image.max() > 1:
            raise ValueError(f"returned values from {image.min()} to {image.max()}, expected 0 to 1")
    return image


def compared(trial: Trial, descriptors: Floats | None, image: Floats | None, notes: tuple[str, ...] = ()) -> Outcome:
    """Every metric of what was recovered; None for a metric of what was not."""
    truth = (trial.pixels() / 255.0).astype(np.float32)
    values = {metric.name(): _measured(metric, trial.secret.descriptors, truth, descriptors, image) for metric in trial.metrics}
    return Outcome(metrics=values, image=image, notes=notes)


def _measured(
    metric: Metric, true_descriptors: Floats, true_image: Floats, descriptors: Floats | None, image: Floats | None
) -> float | None:
    truth, estimate = (true_image, image) if metric.compares == "images" else (true_descriptors, descriptors)
    if estimate is None:
        return None
    with blamed(f"plugin {metric.name()}"):
        value = metric(truth, estimate)
        if value is not None and not np.isfinite(value):
            raise ValueError(f"returned {value}; a metric returns None where its value is not finite")
        return None if value is None else float(value)


PLUGIN = Reconstruction
