"""Fabricated records, for tests of the leaderboard."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from PIL import Image

from bench.registry import spec
from bench.runner import attack_suite
from bench.runner.records import FILE, SCHEMA, experiment_id, run_hash, seal

SIFT = {"name": "sift", "upright": True, "max_keypoints": 1000}
ENVIRONMENT = {"version": "0.1.0", "source": "sha256:" + "5" * 64, "torch": "2.14", "device": "cpu", "threads": 2}
SETTINGS = {"ssim": {"sigma": 1.5}, "mae": {}}
PHOTOGRAPHS = {"name": "photos", "hash": "sha256:" + "a" * 64, "extractor": SIFT}
GALLERY = {"name": "gallery", "hash": "sha256:" + "b" * 64, "extractor": SIFT}
DIA = {"name": "dia", "weights": "sha256:" + "d" * 64}
STANDARD = "standard-2026.1"
UNFIT = "attacks Subspaces; ldp releases WordSets"
DIFFERENCES = np.array([-0.02, 0.01, 0.0, 0.02, -0.01, 0.0])  # between photographs
SCORES = {"blank": 0.1, "keypoints": 0.2, "dia": 0.5, "context": 0.4, "repeat": 0.6, "oracle": 0.7}  # the others do not apply
UNCOVERED = ["the keypoints' positions", "the number of keypoints"]


def ldp(epsilon: float) -> dict[str, Any]:
    return {"name": "ldp", "epsilon": epsilon, "subset_size": 2, "dictionary": "sha256:" + "c" * 64}


def record(
    sample: str,
    metrics: dict[str, Any],
    *,
    defense: dict[str, Any],
    attack: dict[str, Any] | None = DIA,
    task: str = "reconstruction",
    dataset: dict[str, Any] = PHOTOGRAPHS,
    seed: int = 0,
    status: str = "ok",
    reason: str | None = None,
    environment: dict[str, Any] = ENVIRONMENT,
    task_settings: Mapping[str, Any] = MappingProxyType({}),
    settings: dict[str, Any] = SETTINGS,
    **more: Any,
) -> dict[str, Any]:
    """Return one record as the runner writes it."""
    identifier = experiment_id({"name": task, **task_settings}, defense, attack, dataset, seed, settings)
    epsilon = defense.get("epsilon")
    keypoints = metrics.get("keypoints", 100) if status == "ok" else None
    return seal(
        {
            "schema": SCHEMA,
            "task": task,
            "defense": defense,
            "attack": attack,
            "dataset": dataset,
            "task_settings": dict(task_settings),
            "metric_settings": settings,
            "seed": seed,
            "experiment_id": identifier,
            "run_hash": run_hash(identifier, environment),
            "environment": environment,
            "sample": sample,
            "status": status,
            "reason": reason,
            "metrics": metrics,
            "privacy": {
                "guarantee": "none" if epsilon is None else "epsilon-ldp",
                "epsilon_descriptor": epsilon,
                "keypoints": keypoints,
                "releases": 1,
                "epsilon_image": epsilon and keypoints and epsilon * keypoints,
                "epsilon_image_optimal": epsilon and keypoints and epsilon * keypoints * 0.9,
                "delta": 1e-6,
                "uncovered": UNCOVERED,
                "log10_true": None if epsilon is None else -1.0,
                "seeded": True,
                "private": False,
            },
            "seconds": 0.5,
            "notes": [],
        }
        | more
    )


def reconstructions(defense: dict[str, Any], scores: Sequence[float], **more: Any) -> list[dict[str, Any]]:
    """Return one record for each score, an SSIM, of the samples 0.png, 1.png, ..."""
    return [
        record(
            f"{number}.png", {"ssim": score, "mae": round(0.6 - score / 2, 4), "keypoints": 100 + number}, defense=defense, **more
        )
        for number, score in enumerate(scores)
    ]


def run_suite(
    scores: Mapping[str, float] = MappingProxyType(SCORES),
    *,
    epsilon: float = 10.0,
    without: Sequence[str] = (),
    suite: str = STANDARD,
) -> list[dict[str, Any]]:
    """Return the records of a suite with these mean SSIM."""
    records = []
    for number, attack in enumerate(attack_suite.read_attacks([suite])):
        name, encoded = attack.name(), spec.to_json(attack)
        if name in scores:
            values = (scores[name] + np.roll(DIFFERENCES, number)).tolist()
            records += reconstructions(ldp(epsilon), values, attack=encoded)
        elif name not in without:
            records.append(inapplicable(ldp(epsilon), encoded, f"{name} {UNFIT}"))
    return records


def baselines(defense: dict[str, Any], count: int, score: float = 0.002, **more: Any) -> list[dict[str, Any]]:
    """Return the records of both baselines with this SSIM on `count` samples. They serve the other defenses as well."""
    return [
        one
        for name in ("blank", "keypoints")
        for one in reconstructions(defense, [score] * count, **{"attack": {"name": name}, **more})
    ]


def localizations(
    defense: dict[str, Any], hits: Sequence[int], conditions: Sequence[str | None], **more: Any
) -> list[dict[str, Any]]:
    """Return one record for each query: whether it is localized, and under which condition."""
    given = {"task": "localization", "attack": None, "dataset": GALLERY} | more
    return [
        record(f"query/{number}.jpg", _build_metrics(hit), defense=defense, condition=condition, **given)
        for number, (hit, condition) in enumerate(zip(hits, conditions, strict=True))
    ]


def inapplicable(defense: dict[str, Any], attack: dict[str, Any], reason: str, **more: Any) -> dict[str, Any]:
    return record("*", {}, defense=defense, attack=attack, status="n/a", reason=reason, **more)


def write(folder: Path, records: Sequence[dict[str, Any]]) -> Path:
    """Write the records into a folder as `bench run` does."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / FILE).open("w") as file:
        for one in records:
            file.write(json.dumps(seal(one), allow_nan=False) + "\n")
    return folder


def draw_picture(path: Path, seed: int) -> Path:
    """Write a smooth random image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 256, (6, 6, 3), dtype=np.uint8))
    coarse.resize((256, 256), Image.Resampling.BICUBIC).save(path)
    return path


def _build_metrics(hit: int) -> dict[str, Any]:
    return {
        "recall_0.25m_2deg": float(hit),
        "recall_0.5m_5deg": float(hit),
        "recall_5m_10deg": 1.0,
        "translation_error": 0.1 if hit else None,
        "rotation_error": 0.5 if hit else None,
        "inliers": 80 if hit else 5,
        "matches": 120,
        "trials": 1000,
        "keypoints": 150,
    }
