"""The evaluation of samples: the best of several, their diversity, and the check for copies of training photographs."""

from pathlib import Path

import measure_generative
import numpy as np
import pytest
from fakes import write_album
from measure_generative import collect_thumbnails, draw_crop, draw_samples, evaluate, find_nearest, list_crops, select_best

from attacks.generative import Generative
from bench.api import Defense
from bench.cache import store
from bench.extractors.sift import Sift
from bench.identification.distractors import DUPLICATE
from bench.identification.thumbnails import compute_thumbnail
from bench.images import photographs
from bench.images.photographs import list_photographs
from bench.inversion.data import Target
from bench.inversion.plan import Plan, Training
from bench.inversion.train import train
from bench.settings import Asset
from defenses.affine import Affine
from defenses.none import Undefended
from metrics.identity_distance import IdentityDistance
from metrics.ssim import SSIM

DEFENSES: dict[Defense, str] = {Undefended(): "none", Affine(): "affine"}


def test_the_best_sample_is_the_best_for_the_attacker() -> None:
    values = np.array([[0.1, 0.4], [0.3, 0.2]])
    assert select_best(SSIM(), values).tolist() == [0.4, 0.3]
    assert IdentityDistance.higher_is_better_for == "defender"
    assert select_best(IdentityDistance, values).tolist() == [0.1, 0.2]  # type: ignore[arg-type]


def test_copies_of_training_photographs_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also mirrored, rotated and cropped ones. The control has other photographs."""
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    sources = photographs.list_builtin()
    training = collect_thumbnails(sources[:3])
    assert len(training) == 3 * len(list(list_crops(sources[0])))
    crop = draw_crop(sources[1], np.random.default_rng(3)) / 255.0
    copies = np.stack([compute_thumbnail(image) for image in (crop, crop[:, ::-1], np.rot90(crop), np.rot90(crop[::-1], 3))])
    others = np.stack([compute_thumbnail(photographs.read(source).pixels / 255.0) for source in sources[3:]])
    found = find_nearest(copies, training)
    np.testing.assert_allclose(found, found[0])  # a symmetry has no effect
    assert found.min() > find_nearest(others, training).max()
    exact = np.stack([compute_thumbnail(photographs.read(sources[0]).pixels[:, ::-1] / 255.0)])
    assert find_nearest(exact, training) > DUPLICATE


@pytest.mark.slow
def test_the_page_has_all_parts_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(measure_generative, "list_metrics", lambda: [measure_generative.Identified(), SSIM()])
    training, tested = (list_photographs(write_album(tmp_path / name, 2, first)) for name, first in (("train", 0), ("test", 5)))
    out, targets = tmp_path / "W.safetensors", [Target(defense=Undefended(), supported_settings={})]
    steps = Training(steps=2, batch=1, warmup=1)
    train(
        Plan(
            targets=targets,
            photographs=training,
            validation=tested,
            extractor=Sift(),
            widths=(8, 8),
            training=steps,
            model="flow",
        ),
        out,
    )
    attack = Generative(weights=Asset(str(out)), samples=2, steps=1)
    text, configurations = evaluate(DEFENSES, attack, tested, training, "test")
    lines = text.splitlines()
    scores = [line for line in lines if line.startswith(("| prior", "| `generative"))]
    assert sum("| a sample |" in line for line in scores) == sum("best" in line for line in scores) == 2
    assert any("| `dia` on `none`" in line for line in lines)
    assert any("no adapted attacker" in line for line in lines)  # on `affine`
    assert sum("mean image - a sample" in line for line in lines) == sum("a sample - `dia`" in line for line in lines) == 1
    prior = [line for line in scores if line.startswith("| prior")][-1]
    assert prior.rstrip(" |").endswith("0.000 | 0.000")  # the release determines nothing
    assert any(line.startswith("| control: crops of training photographs | 2 |") for line in lines)
    assert len(configurations) == 10

    def fail(*_: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr(measure_generative, "measure_photograph", fail)
    assert evaluate(DEFENSES, attack, tested, training, "test")[0] == text
    figure = draw_samples(list(DEFENSES), attack, tested[:1])
    drawn = [len(axis.images) for axis in figure.axes]
    assert drawn == [1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0]  # none, and affine without a network for samples
