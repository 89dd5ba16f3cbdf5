"""The perceptual loss of VGG: torchvision's own loading of artificial weights, without any download."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import perceptual_loss
import pytest
import torch

from bench.core.errors import UserError

models = pytest.importorskip("torchvision.models", reason="torchvision is not installed (pip install -e '.[lpips]')")
LAYERS = ("features.3", "features.8", "features.15")  # the last layers before VGG-16's first three poolings


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The module, with an empty TORCH_HOME."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    perceptual_loss._load_vgg.cache_clear()
    yield perceptual_loss
    perceptual_loss._load_vgg.cache_clear()


@pytest.fixture
def stored(module: Any) -> dict[str, torch.Tensor]:
    """Weights where torchvision looks for them: random for the first levels, else a repeated zero."""
    torch.manual_seed(0)
    with torch.device("meta"):
        shapes = {name: value.shape for name, value in models.vgg16(weights=None).state_dict().items()}
    weights = {
        name: 0.05 * torch.randn(shape) if int(name.split(".")[1]) < 16 and name[0] == "f" else torch.zeros(1).expand(shape)
        for name, shape in shapes.items()
    }
    module.vgg_file().parent.mkdir(parents=True)
    torch.save(weights, module.vgg_file())
    return weights


@pytest.mark.exhaustive
def test_vgg_features_agree_with_torchvision(module: Any, stored: dict[str, torch.Tensor]) -> None:
    from torchvision.models.feature_extraction import create_feature_extractor

    reference = models.vgg16(weights=None).eval()
    reference.load_state_dict(stored)
    images = torch.rand(2, 3, 64, 64)
    normed = models.VGG16_Weights.IMAGENET1K_V1.transforms(crop_size=64, resize_size=64)(images)
    with torch.no_grad():
        expected = create_feature_extractor(reference, list(LAYERS))(normed)
        raw = create_feature_extractor(reference, list(LAYERS))(images)
    found = module.extract_vgg(images)
    assert [tuple(features.shape[1:]) for features in found] == [(64, 64, 64), (128, 32, 32), (256, 16, 16)]
    for features, name in zip(found, LAYERS, strict=True):
        assert float((features - expected[name]).norm() / expected[name].norm()) < 0.02  # computed in bf16
    assert float((found[0] - raw[LAYERS[0]]).norm() / raw[LAYERS[0]].norm()) > 0.2  # control: colours without normalisation


@pytest.mark.exhaustive
@pytest.mark.usefixtures("stored")
def test_the_loss_grows_with_the_difference_and_has_a_gradient(module: Any) -> None:
    photograph = torch.rand(1, 3, 64, 64)
    noise = torch.randn_like(photograph)
    assert float(module.measure_dissimilarity(photograph, photograph, module.extract_vgg)) == 0
    costs = [
        float(module.measure_dissimilarity(photograph + size * noise, photograph, module.extract_vgg)) for size in (0.05, 0.2)
    ]
    assert 0 < costs[0] < costs[1]
    reconstruction = (photograph + 0.2 * noise).requires_grad_()
    module.measure_dissimilarity(reconstruction, photograph, module.extract_vgg).backward()
    assert reconstruction.grad is not None
    with torch.no_grad():
        nearer = reconstruction - 0.2 * reconstruction.grad / reconstruction.grad.abs().max()
    assert float(module.measure_dissimilarity(nearer, photograph, module.extract_vgg)) < costs[1]


@pytest.mark.slow
def test_nothing_is_downloaded(module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_, **__: pytest.fail("a download"))
    with pytest.raises(UserError, match=r"vgg16-397923af\.pth: no such file"):
        module.extract_vgg(torch.rand(1, 3, 32, 32))
    module.vgg_file().parent.mkdir(parents=True)
    module.vgg_file().write_bytes(b"no weights")
    with pytest.raises(UserError, match="not torchvision's weights of VGG-16"):
        module.extract_vgg(torch.rand(1, 3, 32, 32))
