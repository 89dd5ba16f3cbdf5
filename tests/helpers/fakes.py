"""Synthetic plugins and photographs for tests."""

import dataclasses
import itertools
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageFilter
from scipy.spatial.transform import Rotation

from bench.api import Attack, Defense
from bench.codebook.public import Public
from bench.core import environment
from bench.extractors.sift import Sift
from bench.images.samples import Images
from bench.images.scene import File, Reference, Scene, SceneImage
from bench.runner.plan import Describe, Plan, RunConfiguration, build_plan, cross
from bench.runner.trial import dry_run
from bench.task_api import Task, Trial
from bench.testing import EMPTY_SAMPLE, build_image
from bench.types import Features, Release

FAKES = {
    "feature_privacy.attacks": {
        "sketch": "fake_plugins.sketch:PLUGIN",
        "guess": "fake_plugins.guess:PLUGIN",
        "fatal": "fake_plugins.fatal:PLUGIN",
        "glimpse": "fake_plugins.glimpse:PLUGIN",
    },
    "feature_privacy.defenses": {"broken": "fake_plugins.broken:PLUGIN"},
}


def install_plugins(
    folder: Path, monkeypatch: pytest.MonkeyPatch, groups: dict[str, dict[str, str]], name: str = "made-up"
) -> None:
    """Create a distribution with these entry points on the path, as after an installation."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in points.items()) for group, points in groups.items()]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(folder)


def draw_texture(seed: int, size: tuple[int, int] = (80, 64)) -> Image.Image:
    """Return a blurred random picture in which SIFT finds keypoints. `size` is (width, height)."""
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    return Image.fromarray(noise).filter(ImageFilter.GaussianBlur(2))


def write_album(folder: Path, count: int = 2, first: int = 0) -> Path:
    """Write a folder of photographs, which differ between numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(first, first + count):
        draw_texture(number).save(folder / f"{number}.png")
    return folder


def build_exif(orientation: int, *rational: int) -> bytes:
    """Return EXIF data with an orientation and a signed rational number in place of the resolution."""
    entries = struct.pack("<HHI", 0x112, 3, 1) + struct.pack("<HH", orientation, 0) + struct.pack("<HHII", 0x11A, 10, 1, 38)
    head = b"Exif\0\0II*\0" + struct.pack("<I", 8) + struct.pack("<H", 2)
    return head + entries + struct.pack("<I", 0) + struct.pack("<ii", *rational)


def write_scene(folder: Path, references: int = 3, queries: int = 4) -> Scene:
    """Write a scene of blurred noise with cameras at random positions. The second half of the queries is by night."""
    rng = np.random.default_rng(7)

    def image(name: str, focal: float) -> dict:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        draw_texture(int(rng.integers(1000))).save(path)
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, 80, 64)
        camera.params = [focal, 40.25, 31.5, 0.0123456789012345]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.random(random_state=rng).as_quat()), rng.normal(0, 20, 3))
        return {"name": name, "camera": camera, "cam_from_world": pose, "pixels": File(path=path, size=(80, 64))}

    return Scene(
        name="noise",
        references=tuple(Reference(**image(f"db/{i}.png", 70.0 + i % 2), condition="day") for i in range(references)),
        queries=tuple(
            SceneImage(**image(f"query/{when}/{i}.png", 75.1), condition=when)
            for i, when in enumerate(["day"] * (queries - queries // 2) + ["night"] * (queries // 2))
        ),
    )


def build_trial(
    defense: Defense, secret: Features, *, rng: np.random.Generator | None = None, others: Sequence[Release] = ()
) -> Trial:
    """Return a trial of a task that evaluates the release itself, for features without a photograph."""
    public = Public()
    return Trial(
        sample=EMPTY_SAMPLE,
        images=(build_image(secret, defense.protect(secret, public, np.random.default_rng(1))),),
        defense=defense,
        attack=None,
        extractor=Sift(),
        public=public,
        metrics=(),
        rng=rng or np.random.default_rng(2),
        others=lambda count: iter(others[:count]),
        repeats=(),
    )


def prepare_plan(
    defenses: Sequence[Defense],
    attacks: Sequence[Attack],
    images: Images,
    task: Task,
    describe: Describe = environment.describe,
    **more: Any,
) -> Plan:
    """Build a plan of every pair and dry-run it, as `bench run` does."""
    configuration = RunConfiguration(
        pairs=cross(task, defenses, attacks), images=images, task=task, extractor=Sift(), dataset=None, seed=0
    )
    return check_plan(build_plan(dataclasses.replace(configuration, **more), describe))


def check_plan(plan: Plan) -> Plan:
    """Dry-run a plan and return it."""
    dry_run(plan)
    return plan


@contextmanager
def interrupted_training(after: int) -> Iterator[None]:
    """Interrupt the training inside by Ctrl-C after that many steps, and check that it was interrupted."""
    from bench.inversion import train

    advance, steps = train._Trainer._advance, itertools.count()

    def interrupt(self: Any, *given: Any) -> float:
        if next(steps) == after:
            raise KeyboardInterrupt
        return advance(self, *given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train._Trainer, "_advance", interrupt)
        with pytest.raises(KeyboardInterrupt):
            yield
