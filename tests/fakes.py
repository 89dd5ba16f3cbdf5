"""Plugins and photographs that are made up for tests."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from bench.features.sift import Sift
from bench.plugin import Defense, Trial
from bench.public import Public
from bench.types import Features, Release

FAKES = {
    "feature_privacy.attacks": {"painter": "fake_plugins.painter:PLUGIN", "guess": "fake_plugins.guess:PLUGIN"},
    "feature_privacy.defenses": {"broken": "fake_plugins.broken:PLUGIN"},
}


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, groups: dict[str, dict[str, str]], name: str = "made-up") -> None:
    """Make a distribution with these entry points, as if it had been installed."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in points.items()) for group, points in groups.items()]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(folder)


def texture(seed: int, size: tuple[int, int] = (80, 64)) -> Image.Image:
    """A blurred random picture, in which SIFT finds keypoints. `size` is width, height."""
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    return Image.fromarray(noise).filter(ImageFilter.GaussianBlur(2))


def album(folder: Path, count: int = 2) -> Path:
    """A folder of photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        texture(number).save(folder / f"{number}.png")
    return folder


def trial(defense: Defense, secret: Features, *, rng: np.random.Generator | None = None, others: Sequence[Release] = ()) -> Trial:
    """A trial of a task that judges the release itself, of features without a photograph."""
    public = Public()
    return Trial(
        pixels=np.zeros((*secret.size[::-1], 3), dtype=np.uint8),
        secret=secret,
        release=defense.protect(secret, public, np.random.default_rng(1)),
        defense=defense,
        attack=None,
        extractor=Sift(),
        public=public,
        metrics=(),
        rng=rng or np.random.default_rng(2),
        others=lambda count: iter(others[:count]),
        repeats=(),
    )
