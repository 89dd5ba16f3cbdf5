"""Records what every defense releases and what every attack and task scores on it, at smoke size.

    python tools/golden_record.py write golden.jsonl     # on the code before a change
    python tools/golden_record.py check golden.jsonl     # on the code after it, on the same machine

A release must be the same to the last bit, and a score within 1e-6. Digests of our own source, which enter the keys of rendered
images and of a scene's dictionary, are held constant, so that a change of names is no change of content.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from bench.cache import provenance, store
from bench.core.errors import SampleError
from bench.datasets import gallery
from bench.images import photographs
from bench.registry import discovery, spec
from bench.runner.plan import RunConfiguration
from bench.runner.trial import TrialRunner
from bench.task_api import Task
from bench.types import Release

TOLERANCE = 1e-6
DEFENSES = (
    *("none", "affine", "affine:dim=2", "affine:lifting=random,dim=4", "affine:lifting=adversarial,dim=8"),
    *(
        "ldp",
        "ldp:epsilon=16",
        "ldp:epsilon=6.534,words=8000",
        "ldp:epsilon=12,subset_size=4",
        "naive-ldp",
        "naive-ldp:epsilon=40",
    ),
    *("plateau", "exponential", "privunit", "metric-ldp"),
)
# Fewer releases of other users and fewer neighbours than by default, which change the seconds and not the code that runs.
ATTACKS = {
    "clustering": "clustering:others=3,neighbours=64",
    "intersection": "intersection:others=3,neighbours=64",
}
SCENE = "gallery:views=60,queries=2,width=320,height=240,rooms=1,people=0.5"
WALK = "walk:views=4,others=6,width=320,height=240"
FEW = "sift:max_keypoints=300"


@dataclasses.dataclass(frozen=True)
class Case:
    """One plan: a task on its samples by an extractor, with every pair of these defenses and attacks."""

    task: str
    defenses: tuple[str, ...]
    attacks: tuple[str | None, ...] = (None,)
    extractor: str = "sift"
    dataset: str | None = None
    photographs: tuple[str, ...] | None = None
    samples: int = 1


def cases() -> Iterator[Case]:
    every = tuple(ATTACKS.get(plugin.name(), plugin.name()) for plugin in discovery.load_plugins(discovery.ATTACK))
    yield Case("reconstruction", DEFENSES, every, photographs=("rocket", "coffee"))
    yield Case(
        "reconstruction", ("none", "ldp", "affine"), ("dia", "keypoints"), "sift:upright=false", photographs=("rocket", "coffee")
    )
    yield Case("reconstruction", ("none", "affine", "ldp:epsilon=16"), ("inlier", "dia"), FEW, SCENE, samples=2)
    yield Case("matching:each=1", DEFENSES, samples=1)
    yield Case("matching:each=1,both=true,ratio=0.9", ("none", "affine", "ldp:epsilon=16"), samples=1)
    yield Case("collisions:others=3", DEFENSES, photographs=("rocket", "coffee"))
    yield Case("intersections:subspaces=96", DEFENSES, photographs=("rocket", "coffee"))
    ldp = ("ldp:epsilon=10,words=800", "ldp:epsilon=inf,subset_size=1,words=800")
    yield Case("localization:trials=2000", ("none", "affine", "privunit", *ldp), extractor=FEW, dataset=SCENE, samples=2)
    yield Case("localization:trials=2000,retrieval=released", ("none", *ldp), extractor=FEW, dataset=SCENE, samples=2)
    yield Case("structure", ("none", "affine", "ldp:words=8000,epsilon=16"), extractor=FEW, dataset=WALK)


def write(file: Any) -> None:
    for case in cases():
        for line in measured(case):
            file.write(json.dumps(line) + "\n")
            file.flush()


def measured(case: Case) -> Iterator[dict[str, Any]]:
    """One line for each pair on each sample."""
    plan = planned(case)
    trials = TrialRunner(plan)
    for unit in plan.samples[: case.samples]:
        for cell in plan.experiments:
            line: dict[str, Any] = {
                "case": [case.task, case.extractor, case.dataset],
                "defense": spec.to_json(cell.defense),
                "attack": cell.attack and spec.to_json(cell.attack),
                "sample": unit.name,
            }
            if cell.reason is not None:
                yield line | {"applies": False}
                continue
            try:
                trial = trials.build_trial(cell, unit)
                outcome = plan.task.evaluate(trial)
            except SampleError as error:
                yield line | {"applies": True, "failed": type(error).__name__}
                continue
            others = list(trial.others(2)) if cell.attack is not None else []
            releases = [*(shot.release for shot in trial.images), *trial.repeats, *others]
            image = None if outcome.image is None else [float(outcome.image.mean()), float(outcome.image.std())]
            yield line | {
                "applies": True,
                "releases": [digest(release) for release in releases],
                "metrics": dict(outcome.metrics),
                "image": image,
            }


def planned(case: Case) -> Any:
    sources = [source for source in photographs.list_builtin() if case.photographs is not None and source.name in case.photographs]
    task: Task = spec.read(case.task, discovery.TASK)
    attacks = [None if text is None else spec.read(text, discovery.ATTACK) for text in case.attacks]
    pairs = [(spec.read(text, discovery.DEFENSE), attack) for text in case.defenses for attack in attacks]
    return build_plan(
        RunConfiguration(
            pairs=tuple(pairs),
            images=sources or None,
            task=task,
            extractor=spec.read(case.extractor, discovery.EXTRACTOR),
            dataset=None if case.dataset is None else spec.read(case.dataset, discovery.DATASET),
            seed=5,
        )
    )


def arrays(release: Release) -> dict[str, np.ndarray]:
    """All that is released, by names that do not depend on how the class is written."""
    found = {"keypoints": release.keypoints, "size": np.array(release.size, np.int64)}
    for name in ("descriptors", "frames", "origins", "bases", "candidates", "words"):
        if (value := getattr(release, name, None)) is not None:
            found[name] = value
    return found


def digest(release: Release) -> str:
    hashed = hashlib.sha256()
    for name, array in sorted(arrays(release).items()):
        hashed.update(f"{name} {array.dtype} {array.shape}".encode())
        hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()


def differences(before: list[dict[str, Any]], after: list[dict[str, Any]]) -> Iterator[str]:
    if len(before) != len(after):
        yield f"{len(before)} lines before, {len(after)} after"
    for old, new in zip(before, after, strict=False):
        label = f"{old['case'][0]} {old['defense']['name']} {old['attack'] and old['attack']['name']} {old['sample']}"
        for name in old.keys() | new.keys():
            if name in ("metrics", "image"):
                if not close(old.get(name), new.get(name)):
                    yield f"{label}: {name} {old.get(name)} -> {new.get(name)}"
            elif old.get(name) != new.get(name):
                yield f"{label}: {name} {old.get(name)} -> {new.get(name)}"


def close(old: Any, new: Any) -> bool:
    if isinstance(old, dict) and isinstance(new, dict):
        return old.keys() == new.keys() and all(close(old[key], new[key]) for key in old)
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(map(close, old, new))
    if isinstance(old, float) and isinstance(new, float):
        return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return bool(old == new)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("write", "check"))
    parser.add_argument("file", type=Path)
    options = parser.parse_args()
    provenance.hash_modules = lambda *modules: "sha256:constant"
    gallery._hash_renderer = lambda: "constant"
    with tempfile.TemporaryDirectory() as folder, store.use_folder(Path(folder)):
        if options.what == "write":
            with options.file.open("w") as file:
                write(file)
            return 0
        with tempfile.TemporaryFile("w+") as file:
            write(file)
            file.seek(0)
            after = [json.loads(line) for line in file]
    found = list(differences([json.loads(line) for line in options.file.open()], after))
    print("\n".join(found) or f"{len(after)} lines: the same")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
