"""A record with few fields, for tests of tables."""

from typing import Any

from bench.runner.records import SCHEMA, seal

SIFT = {"name": "sift", "upright": True}


def record(sample: str = "a", **more: Any) -> dict[str, Any]:
    return seal(
        {
            "schema": SCHEMA,
            "experiment_id": "c",
            "run_hash": "r",
            "task": "reconstruction",
            "defense": {"name": "ldp", "epsilon": 10.0, "dictionary": "sha256:0123456789"},
            "attack": {"name": "dia", "weights": "sha256:ab"},
            "dataset": {"name": "photos", "hash": "sha256:0", "extractor": SIFT},
            "task_settings": {},
            "metric_settings": {},
            "environment": {"source": "sha256:0"},
            "seed": 0,
            "sample": sample,
            "status": "ok",
            "reason": None,
            "metrics": {"mae": 0.1, "psnr": 20.0, "ssim": 0.5, "angle": None, "keypoints": 100},
            "privacy": {"guarantee": "epsilon-ldp", "epsilon_descriptor": 10.0, "epsilon_image": 1000.0, "log10_true": -0.8},
            "notes": [],
        }
        | more
    )
