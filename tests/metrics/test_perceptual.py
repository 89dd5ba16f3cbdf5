"""The perceptual distance against values of its authors' code, and on pairs with known answers."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from bench import testing
from bench.core.errors import UserError
from bench.images import photographs
from bench.registry import discovery

pytest.importorskip("lpips", reason="the library is not installed (pip install -e '.[perceptual]')")

import torchvision

import metrics.perceptual as module
from metrics.perceptual import Perceptual

pytestmark = pytest.mark.usefixtures("no_connections")


@pytest.fixture(scope="module")
def metric() -> Perceptual:
    try:
        return Perceptual()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def pairs() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The astronaut, and other images. (256, 256, 3) float32 in [0, 1]"""
    astronaut, _, admiral = (photographs.read(source.path).pixels for source in photographs.list_people())
    noise = torch.rand((1, 3, 256, 256), generator=torch.Generator().manual_seed(0))[0].permute(1, 2, 0).numpy()
    others = {
        "same": astronaut / 255,
        "grey": np.full(astronaut.shape, 0.5),
        "other": admiral / 255,
        "noise": noise,
        **{f"blur {s}": np.rint(gaussian_filter(astronaut.astype(float), (s, s, 0))) / 255 for s in (1, 2, 4)},
    }
    return {name: ((astronaut / 255).astype(np.float32), other.astype(np.float32)) for name, other in others.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ("same", 0.0),
        ("grey", 1.1156270),
        ("other", 0.6218816),
        ("noise", 0.8980177),
        ("blur 1", 0.1725569),
        ("blur 2", 0.4951178),
        ("blur 4", 0.7398251),
    ],
)
def test_values_of_the_authors_code(
    metric: Perceptual, pairs: dict[str, tuple[np.ndarray, np.ndarray]], pair: str, expected: float
) -> None:
    """Of stlpips-pytorch 0.0.2 on the same images. A strong blur is farther than another portrait."""
    assert metric(*pairs[pair]) == pytest.approx(expected, abs=1e-5)


@pytest.mark.slow
def test_control_without_blurs_the_values_differ(
    metric: Perceptual, pairs: dict[str, tuple[np.ndarray, np.ndarray]], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = module._load_network(metric.weights)
    for parameter in network.net.parameters():
        if parameter.shape[1:] == (1, 3, 3):  # a filter that keeps the pixel in its centre
            monkeypatch.setattr(parameter, "data", torch.zeros_like(parameter))
            parameter.data[:, :, 1, 1] = 1
    assert abs(metric(*pairs["blur 1"]) - 0.1725569) > 1e-3


@pytest.mark.slow
def test_a_shift_of_one_pixel_is_nearer_than_a_slight_blur(
    metric: Perceptual, pairs: dict[str, tuple[np.ndarray, np.ndarray]]
) -> None:
    astronaut, blurred = pairs["blur 1"]
    assert 0 < metric(astronaut, np.roll(astronaut, 1, axis=1)) < metric(astronaut, blurred)


@pytest.mark.slow
def test_contract_of_metrics(metric: Perceptual) -> None:
    discovery.check(discovery.METRIC, Perceptual)
    testing.check_metric(metric)


@pytest.mark.slow
def test_nothing_is_downloaded(metric: Perceptual, pairs: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    module._load_network.cache_clear()
    assert metric(*pairs["same"]) == 0.0
    with pytest.raises(AssertionError, match="a connection"):  # negative control: weights of another project
        torchvision.models.alexnet(weights="DEFAULT")


@pytest.mark.slow
def test_other_files_are_refused(metric: Perceptual, pairs: dict[str, tuple[np.ndarray, np.ndarray]], tmp_path: Path) -> None:
    vgg = metric.weights.with_name("vgg_shift_tolerant.pth")
    part = tmp_path / "part.pth"
    torch.save({"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}, part)
    for wrong in (vgg, part):
        with pytest.raises(UserError, match=f"{wrong.name}: not the weights of ST-LPIPS"):
            Perceptual(weights=wrong)(*pairs["same"])
    with pytest.raises(UserError, match="absent: no such file"):
        Perceptual(weights=tmp_path / "absent")


def test_without_the_library_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'feature-privacy-bench\[perceptual\]'"):
        Perceptual()
