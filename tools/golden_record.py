"""Records what every defense releases and what every attack and task scores on it, at smoke size.

    python tools/golden_record.py write tests/data/golden.jsonl     # on the code before a change
    python tools/golden_record.py check tests/data/golden.jsonl     # on the code after it, on the same machine

A release must be the same to the last bit, and a score within 1e-6. Attacks and metrics that the file lacks are new, and are not
compared; nor are attacks that did not apply and do now. Those that are gone are differences. Digests of our own source, which
enter the keys of rendered images and of a scene's dictionary, are held constant, so a change of names is no change of content.
Other processors and libraries round differently: the first line holds both, and `check` says so where they differ.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import json
import math
import os
import platform
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from bench.cache import provenance, store
from bench.core import environment, hashing
from bench.core.errors import SampleError
from bench.datasets import gallery
from bench.images import photographs
from bench.registry import discovery, spec
from bench.runner.plan import Plan, RunConfiguration, build_plan
from bench.runner.trial import TrialRunner
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


def measure_all(selected: Sequence[Case]) -> Iterator[dict[str, Any]]:
    """Yield the lines of these cases."""
    for case in selected:
        yield from measure(case)


def measure(case: Case) -> Iterator[dict[str, Any]]:
    """Yield one line for each pair on each sample."""
    plan = plan_case(case)
    runner = TrialRunner(plan)
    for sample in plan.samples[: case.samples]:
        for experiment in plan.experiments:
            line: dict[str, Any] = {
                "case": [case.task, case.extractor, case.dataset],
                "defense": spec.to_json(experiment.defense),
                "attack": experiment.attack and spec.to_json(experiment.attack),
                "sample": sample.name,
            }
            if experiment.reason is not None:
                yield line | {"applies": False}
                continue
            try:
                trial = runner.build_trial(experiment, sample)
                outcome = plan.task.evaluate(trial)
            except SampleError as error:
                yield line | {"applies": True, "failed": type(error).__name__}
                continue
            others = list(trial.others(2)) if experiment.attack is not None else []
            releases = [*(image.release for image in trial.images), *trial.repeats, *others]
            image = None if outcome.image is None else [float(outcome.image.mean()), float(outcome.image.std())]
            yield line | {
                "applies": True,
                "releases": [digest(release) for release in releases],
                "metrics": dict(outcome.metrics),
                "image": image,
            }


def plan_case(case: Case) -> Plan:
    sources = [
        source for source in photographs.list_builtin() if case.photographs is not None and source.name in case.photographs
    ]
    attacks = [None if text is None else spec.read(text, discovery.ATTACK) for text in case.attacks]
    pairs = [(spec.read(text, discovery.DEFENSE), attack) for text in case.defenses for attack in attacks]
    return build_plan(
        RunConfiguration(
            pairs=tuple(pairs),
            images=sources or None,
            task=spec.read(case.task, discovery.TASK),
            extractor=spec.read(case.extractor, discovery.EXTRACTOR),
            dataset=None if case.dataset is None else spec.read(case.dataset, discovery.DATASET),
            seed=5,
        )
    )


def arrays(release: Release) -> dict[str, np.ndarray]:
    """Return all arrays of a release, by names that do not depend on its class."""
    content: dict[str, np.ndarray] = {"keypoints": release.keypoints, "size": np.array(release.size, np.int64)}
    for name in ("descriptors", "frames", "origins", "bases", "candidates", "words"):
        if (value := getattr(release, name, None)) is not None:
            content[name] = value
    return content


def digest(release: Release) -> str:
    hashed = hashlib.sha256()
    for name, array in sorted(arrays(release).items()):
        hashed.update(f"{name} {array.dtype} {array.shape}".encode())
        hashed.update(np.ascontiguousarray(array).tobytes())
    return hashed.hexdigest()


def find_differences(before: Sequence[dict[str, Any]], after: Iterable[dict[str, Any]]) -> Iterator[str]:
    """Yield a message for each difference of a line after the change to the line before it with the same label.

    Lines of new attacks and values of new metrics have none before the change, and are left out. So is an attack that did not
    apply before, such as one without a network. A line that is gone is reported, if another line of its case is there.
    """
    known = {label(line): line for line in before}
    attacks = {_name_attack(line) for line in before}
    measured, measured_cases = set(), set()
    for new in after:
        measured.add(label(new))
        measured_cases.add(json.dumps(new["case"]))
        if _name_attack(new) not in attacks:
            continue
        old = known.get(label(new), {})
        if new.get("applies") and old.get("applies") is False:
            continue
        for name in sorted(old.keys() | new.keys()):
            value = new.get(name)
            if name == "metrics" and value and old.get(name):
                value = {metric: value[metric] for metric in value if metric in old[name]}
            if not close(old.get(name), value):
                yield f"{label(new)}: {name} was {old.get(name)}, is {value}"
    for line in before:
        if json.dumps(line["case"]) in measured_cases and label(line) not in measured:
            yield f"{label(line)}: is gone"


def _name_attack(line: dict[str, Any]) -> str | None:
    return line["attack"] and line["attack"]["name"]


def label(line: dict[str, Any]) -> str:
    return json.dumps([line[name] for name in ("case", "defense", "attack", "sample")], sort_keys=True)


def close(old: Any, new: Any) -> bool:
    if isinstance(old, dict) and isinstance(new, dict):
        return old.keys() == new.keys() and all(close(old[key], new[key]) for key in old)
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(map(close, old, new))
    if isinstance(old, float) and isinstance(new, float):
        return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return bool(old == new)


@contextlib.contextmanager
def constant_sources() -> Iterator[None]:
    """Hold the digests of our own source constant, and use an empty cache."""
    with (
        mock.patch.object(provenance, "hash_modules", return_value="sha256:constant"),
        mock.patch.object(gallery, "_hash_renderer", return_value="constant"),
        tempfile.TemporaryDirectory() as folder,
        store.use_folder(Path(folder)),
    ):
        yield


def describe_machine() -> dict[str, Any]:
    """Return what numbers may depend on beside our own source: libraries, and the processor that selects their kernels."""
    cpuinfo = Path("/proc/cpuinfo")
    processor = cpuinfo.read_text(encoding="utf-8").partition("\n\n")[0] if cpuinfo.is_file() else platform.processor()
    names = ("vendor_id", "cpu family", "model", "model name", "flags")
    lines = [line for line in processor.splitlines() if line.partition("\t")[0].strip() in names] or [processor]
    kernels = {name: os.environ.get(name) for name in ("OPENBLAS_CORETYPE", "MKL_ENABLE_INSTRUCTIONS")}
    return environment.describe_platform() | {"threads": 0, "processor": hashing.short_hash([lines, kernels])}


def read(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the machine and the lines of a golden record."""
    machine, *lines = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    return machine, lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("write", "check"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--case", type=int, action="append", help="number of a case, from 0; may be given several times")
    options = parser.parse_args()
    every = list(cases())
    selected = [every[number] for number in options.case] if options.case else every
    with constant_sources():
        if options.action == "write":
            with options.file.open("w", encoding="utf-8") as file:
                for line in (describe_machine(), *measure_all(selected)):
                    file.write(json.dumps(line) + "\n")
            return 0
        machine, before = read(options.file)
        if machine != describe_machine():
            print(f"written on another machine: {machine}")
        count = 0
        for message in find_differences(before, measure_all(selected)):
            print(message, flush=True)
            count += 1
    print(f"{count} differences")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
