"""VGG's eye: torchvision's own loading, of weights that are made up here, and nothing that is downloaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import perceptual_loss
import pytest
import torch

from bench.core.errors import UserError

models = pytest.importorskip("torchvision.models", reason="torchvision is not installed (pip install -e '.[lpips]')")
SEEN = ("features.3", "features.8", "features.15")  # the last layers before VGG-16's first three poolings


@pytest.fixture
def perceived(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The module, in a home without weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    perceptual_loss._vgg.cache_clear()
    yield perceptual_loss
    perceptual_loss._vgg.cache_clear()


@pytest.fixture
def given(perceived: Any) -> dict[str, torch.Tensor]:
    """Weights where torchvision looks for them: the first levels' drawn at random, those of others a zero that repeats."""
    torch.manual_seed(0)
    with torch.device("meta"):
        shapes = {name: value.shape for name, value in models.vgg16(weights=None).state_dict().items()}
    weights = {
        name: 0.05 * torch.randn(shape) if int(name.split(".")[1]) < 16 and name[0] == "f" else torch.zeros(1).expand(shape)
        for name, shape in shapes.items()
    }
    perceived.vgg_file().parent.mkdir(parents=True)
    torch.save(weights, perceived.vgg_file())
    return weights


def test_vgg_sees_as_torchvisions_does(perceived: Any, given: dict[str, torch.Tensor]) -> None:
    from torchvision.models.feature_extraction import create_feature_extractor

    reference = models.vgg16(weights=None).eval()
    reference.load_state_dict(given)
    images = torch.rand(2, 3, 64, 64)
    normed = models.VGG16_Weights.IMAGENET1K_V1.transforms(crop_size=64, resize_size=64)(images)
    with torch.no_grad():
        wanted = create_feature_extractor(reference, list(SEEN))(normed)
        raw = create_feature_extractor(reference, list(SEEN))(images)
    found = perceived.vggs(images)
    assert [tuple(features.shape[1:]) for features in found] == [(64, 64, 64), (128, 32, 32), (256, 16, 16)]
    for features, name in zip(found, SEEN, strict=True):
        assert float((features - wanted[name]).norm() / wanted[name].norm()) < 0.02  # it is in bf16
    assert float((found[0] - raw[SEEN[0]]).norm() / raw[SEEN[0]].norm()) > 0.2  # the control: colours that are not normed


@pytest.mark.usefixtures("given")
def test_what_is_less_alike_costs_more_and_has_a_gradient(perceived: Any) -> None:
    photograph = torch.rand(1, 3, 64, 64)
    noise = torch.randn_like(photograph)
    assert float(perceived.unlike(photograph, photograph, perceived.vggs)) == 0
    costs = [float(perceived.unlike(photograph + size * noise, photograph, perceived.vggs)) for size in (0.05, 0.2)]
    assert 0 < costs[0] < costs[1]
    painted = (photograph + 0.2 * noise).requires_grad_()
    perceived.unlike(painted, photograph, perceived.vggs).backward()
    assert painted.grad is not None
    with torch.no_grad():
        nearer = painted - 0.2 * painted.grad / painted.grad.abs().max()
    assert float(perceived.unlike(nearer, photograph, perceived.vggs)) < costs[1]


def test_nothing_is_downloaded(perceived: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_, **__: pytest.fail("a download"))
    with pytest.raises(UserError, match=r"vgg16-397923af\.pth: no such file"):
        perceived.vggs(torch.rand(1, 3, 32, 32))
    perceived.vgg_file().parent.mkdir(parents=True)
    perceived.vgg_file().write_bytes(b"no weights")
    with pytest.raises(UserError, match="not torchvision's weights of VGG-16"):
        perceived.vggs(torch.rand(1, 3, 32, 32))
