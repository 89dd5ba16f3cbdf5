"""LPIPS with random weights against its formula, and the option `--metric`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_plugins.sketch import Sketch
from fakes import FAKES, install_plugins, write_album

from bench import cli, testing
from bench.core.errors import UserError
from bench.registry import discovery, spec
from bench.runner.plan import RunConfiguration, build_plan
from defenses.none import Undefended

pytest.importorskip("lpips", reason="the library is not installed (pip install -e '.[lpips]')")
torchvision = pytest.importorskip("torchvision", reason="torchvision is not installed (pip install -e '.[lpips]')")

from metrics.lpips import LPIPS  # noqa: E402

RELUS = (1, 4, 7, 9, 11)  # of AlexNet's layers, those that the paper compares after
SHIFT, SCALE = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of AlexNet, since the formula does not depend on training."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "alexnet.pth"
    torch.save(torchvision.models.alexnet(weights=None).state_dict(), path)
    return path


@pytest.fixture(scope="module")
def images() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.random((96, 80, 3), dtype=np.float32)
    return truth, np.clip(truth + rng.normal(0, 0.2, truth.shape), 0, 1).astype(np.float32)


def by_definition(weights: Path, truth: np.ndarray, estimate: np.ndarray) -> float:
    """Return Eq. (1) of Zhang et al.: squared differences of unit-norm features, weighted by channel, averaged and summed."""
    import lpips

    network = torchvision.models.alexnet(weights=None).eval()
    network.load_state_dict(torch.load(weights, weights_only=True))
    heads = torch.load(Path(lpips.__file__).parent / "weights" / "v0.1" / "alex.pth", map_location="cpu", weights_only=True)
    layers: list[list[np.ndarray]] = []
    for image in (truth, estimate):
        x = torch.from_numpy((((image * 2.0 - 1.0) - SHIFT) / SCALE).astype(np.float32)).permute(2, 0, 1)[None]
        found = []
        for index, layer in enumerate(network.features):
            x = layer(x)
            if index in RELUS:
                features = x[0].detach().numpy().astype(np.float64).copy()  # (C, h, w)
                found.append(features / (np.linalg.norm(features, axis=0) + 1e-10))
        layers.append(found)
    total = 0.0
    for number, (one, other) in enumerate(zip(*layers, strict=True)):
        weight = heads[f"lin{number}.model.1.weight"][0, :, 0, 0].numpy()
        total += float(np.einsum("c,chw->hw", weight, (one - other) ** 2).mean())
    return total


@pytest.mark.slow
def test_formula_of_the_paper(weights: Path, images: tuple[np.ndarray, np.ndarray]) -> None:
    found = LPIPS(weights=weights)(*images)
    assert found == pytest.approx(by_definition(weights, *images), rel=1e-4)
    assert found > 0


@pytest.mark.slow
def test_contract_of_metrics(weights: Path) -> None:
    discovery.check(discovery.METRIC, LPIPS)
    testing.check_metric(LPIPS(weights=weights))


def test_its_settings_are_the_weights_by_content(weights: Path, tmp_path: Path) -> None:
    write_album(tmp_path / "album", 1)
    plan = build_plan(
        RunConfiguration(
            pairs=((Undefended(), Sketch()),),
            images=tmp_path / "album",
            task=spec.read("reconstruction", discovery.TASK),
            extractor=spec.read("sift", discovery.EXTRACTOR),
            dataset=None,
            seed=0,
            metrics=(LPIPS(weights=weights),),
        )
    )
    settings = plan.experiments[0].metadata["metric_settings"]
    assert settings["lpips"]["weights"].startswith("sha256:")
    assert settings["lpips"]["network"] == "alex"
    assert "ssim" in settings


@pytest.mark.slow
def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="absent: no such file"):
        LPIPS(weights=tmp_path / "absent")
    wrong = tmp_path / "wrong.pth"
    torch.save({"features.0.weight": torch.zeros(3)}, wrong)
    with pytest.raises(UserError, match="not torchvision's weights of AlexNet"):
        LPIPS(weights=wrong)
    wrong.write_bytes(b"nothing of the kind")
    with pytest.raises(UserError, match="not torchvision's weights of AlexNet"):
        LPIPS(weights=wrong)


@pytest.mark.slow
def test_it_is_measured_only_on_request(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)
    write_album(tmp_path / "album", 1)
    monkeypatch.chdir(tmp_path)
    command = ["run", "--defense", "none", "--attack", "sketch", "--images", "album", "--json"]

    def metrics(*more: str) -> dict[str, Any]:
        import json

        assert cli.main([*command, *more]) == 0
        return dict(json.loads(capsys.readouterr().out)["metrics"])

    assert "lpips" not in metrics("--out", "a")
    assert metrics("--out", "b", "--metric", f"lpips:weights={weights}")["lpips"] > 0
    assert cli.main([*command, "--metric", "ssim", "--out", "c"]) == 2
    assert "--metric ssim: remove it" in capsys.readouterr().err
    assert cli.main([*command, "--metric", "lpips", "--out", "c"]) == 2
    assert "lpips needs weights (a path)" in capsys.readouterr().err
    assert not Path("c").exists()
