"""Metrics against scikit-image, hand-computed values and chance levels."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import trapezoid
from skimage import metrics as reference

from bench.api import Metric
from bench.cache import store
from bench.identification import faces
from bench.identification.faces import compute_overlap
from bench.images import photographs
from metrics import angle, face, identified, l2, mae, mse, psnr, recovered, ssim
from metrics.position_auc_5 import PositionAUC5
from metrics.position_auc_10 import PositionAUC10
from metrics.position_auc_25 import PositionAUC25
from metrics.position_error import PositionError

IMAGES = [face.PLUGIN, identified.PLUGIN, mae.PLUGIN, mse.PLUGIN, psnr.PLUGIN, ssim.PLUGIN]
DESCRIPTORS = [angle.PLUGIN, l2.PLUGIN, recovered.PLUGIN]


@pytest.fixture(params=[(0, 0.02), (1, 0.3), (2, 1.0)], ids=["close", "noisy", "unlike"])
def images(request: Any) -> tuple[np.ndarray, np.ndarray]:
    """A smooth image and a disturbed one. (H, W, 3) float32 in [0, 1]"""
    seed, noise = request.param
    rng = np.random.default_rng(seed)
    waves = np.sin(np.linspace(0, 9, 48)[:, None, None] * rng.uniform(0.5, 2, 3)) * np.cos(np.linspace(0, 7, 40)[None, :, None])
    truth = (waves + 1) / 2
    estimate = np.clip(truth + rng.normal(0, noise, truth.shape), 0, 1)
    return truth.astype(np.float32), estimate.astype(np.float32)


def normalize_rows(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


# ---- images


@pytest.mark.slow
def test_image_errors_equal_scikit_image(images: tuple[np.ndarray, np.ndarray]) -> None:
    truth, estimate = images
    exact = truth.astype(np.float64), estimate.astype(np.float64)
    assert mse.PLUGIN()(truth, estimate) == pytest.approx(reference.mean_squared_error(*exact), abs=1e-12)
    expected = reference.peak_signal_noise_ratio(*exact, data_range=1.0)
    assert psnr.PLUGIN()(truth, estimate) == pytest.approx(expected, abs=1e-6)
    by_hand = math.fsum(abs(float(a) - float(b)) for a, b in zip(truth.flat, estimate.flat, strict=True)) / truth.size
    assert mae.PLUGIN()(truth, estimate) == pytest.approx(by_hand, abs=1e-12)


def ssim_by_definition(truth: np.ndarray, estimate: np.ndarray) -> float:
    """Return SSIM by the formula of Wang et al. with SciPy's Gaussian. As in scikit-image, the border does not count."""
    from scipy.ndimage import gaussian_filter

    blur = partial(gaussian_filter, sigma=(1.5, 1.5, 0), truncate=3.5, mode="reflect")
    x, y = truth.astype(np.float64), estimate.astype(np.float64)
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    similarity = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return float(similarity[5:-5, 5:-5].mean())


def same_ssim(metric: Any, images: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether SSIM agrees with both references to 1e-6."""
    value = metric(*images)
    library = reference.structural_similarity(
        *(image.astype(np.float64) for image in images),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=2,
    )
    return abs(value - library) < 1e-6 and abs(value - ssim_by_definition(*images)) < 1e-6


def test_ssim_equals_both_references(images: tuple[np.ndarray, np.ndarray]) -> None:
    assert same_ssim(ssim.PLUGIN(), images)


@pytest.mark.parametrize(
    "other",
    [
        {"gaussian_weights": False},  # scikit-image's default, a uniform window
        {"use_sample_covariance": True},
        {"sigma": 1.0},
        {"data_range": 2.0},  # the default for floats
    ],
    ids=str,
)
def test_control_ssim_with_other_settings_fails(images: tuple[np.ndarray, np.ndarray], other: dict) -> None:
    wrong = partial(reference.structural_similarity, **{**ssim.PLUGIN.parameters, **other})
    assert not same_ssim(wrong, images)


def test_equal_images() -> None:
    image = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    assert psnr.PLUGIN()(image, image) is None
    assert mse.PLUGIN()(image, image) == 0 == mae.PLUGIN()(image, image)
    assert ssim.PLUGIN()(image, image) == pytest.approx(1.0, abs=1e-12)


def test_arithmetic_is_float64() -> None:
    """A difference of 2^-12 in one of 3·2^20 values would be lost in float32's mean of squares."""
    truth = np.zeros((1024, 1024, 3), dtype=np.float32)
    estimate = truth.copy()
    estimate[0, 0, 0], estimate[-1, -1, -1] = 1.0, 2.0**-12
    assert mse.PLUGIN()(truth, estimate) == (1 + 2.0**-24) / truth.size


# ---- descriptors


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 45.0, 90.0, 179.999, 180.0])
def test_angle_is_exact_at_both_ends(degrees: float) -> None:
    theta = math.radians(degrees)
    truth = np.array([[1.0, 0.0, 0.0]] * 3)
    estimate = np.array([[math.cos(theta), math.sin(theta), 0.0]] * 3)
    assert angle.PLUGIN()(truth, estimate) == pytest.approx(degrees, rel=1e-9, abs=1e-12)


def test_control_arccos_of_the_dot_product_is_not_exact() -> None:
    theta = math.radians(1e-7)
    assert math.degrees(math.acos(math.cos(theta))) != pytest.approx(1e-7, rel=1e-3)


def test_angle_is_a_mean_and_handles_zero_rows() -> None:
    truth = np.array([[1, 0], [1, 0], [0, 1]], dtype=np.float32)
    estimate = np.array([[1, 0], [0, 1], [0, 0]], dtype=np.float32)
    assert angle.PLUGIN()(truth, estimate) == pytest.approx((0 + 90 + 90) / 3)


def test_l2_is_the_mean_of_distances() -> None:
    truth = np.array([[1, 0], [1, 0], [0, 1]], dtype=np.float32)
    estimate = np.array([[-1, 0], [0, 1], [0, 1]], dtype=np.float32)
    assert l2.PLUGIN()(truth, estimate) == pytest.approx((2 + math.sqrt(2) + 0) / 3, abs=1e-12)


def test_recovered_counts_estimates_nearest_to_their_own() -> None:
    truth = np.eye(4, dtype=np.float32)
    estimate = normalize_rows(np.array([[0.6, 0.5, 0, 0], [0.6, 0.5, 0, 0], [0, 0, 1, 0], [0, 0, 0, -1]]))
    # 0 and 2 are nearest to their own; 1 is nearest to 0; 3 ties with cosine 0 between 0, 1 and 2.
    assert recovered.PLUGIN()(truth, estimate) == 0.5
    assert recovered.PLUGIN()(truth, truth) == 1.0


def test_recovered_ties_go_to_the_lowest_index() -> None:
    truth = np.eye(3, dtype=np.float32)
    nothing = np.zeros_like(truth)
    assert recovered.PLUGIN()(truth, nothing) == pytest.approx(1 / 3)


def test_recovered_counts_equal_descriptors_as_one_candidate() -> None:
    truth = np.eye(3, dtype=np.float32)[[0, 0, 1]]
    assert recovered.PLUGIN()(truth, truth) == 1.0


def test_recovered_in_parts_equals_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    truth = rng.normal(size=(30, 8)).astype(np.float32)
    estimate = truth + rng.normal(size=(30, 8)).astype(np.float32)
    at_once = recovered.PLUGIN()(truth, estimate)
    monkeypatch.setattr(recovered, "COSINES", 7 * 30)
    assert 0 < at_once < 1
    assert recovered.PLUGIN()(truth, estimate) == at_once


def test_recovered_chance_level() -> None:
    """A constant guess gives exactly 1 / N; independent guesses give it on average."""
    rng = np.random.default_rng(0)
    truth = normalize_rows(rng.normal(size=(200, 16)))
    same = np.repeat(normalize_rows(rng.normal(size=(1, 16))), 200, axis=0)
    assert recovered.PLUGIN()(truth, same) == pytest.approx(1 / 200)
    hits = sum(round(200 * recovered.PLUGIN()(truth, normalize_rows(rng.normal(size=(200, 16))))) for _ in range(50))
    assert 20 <= hits <= 85  # 50 are expected; about Poisson, so within 5 deviations


# ---- faces


@pytest.fixture(scope="module")
def portrait() -> np.ndarray:
    """The astronaut, whose face the detector finds. (256, 256, 3) float32 in [0, 1]"""
    (astronaut, *_) = photographs.list_people()
    return (photographs.read(astronaut.path).pixels / 255).astype(np.float32)


@pytest.mark.slow
def test_a_face_counts_only_at_its_position(portrait: np.ndarray) -> None:
    metric = face.PLUGIN()
    assert metric(portrait, portrait.copy()) == 1.0
    darker = portrait * np.float32(0.8)
    assert metric(portrait, darker) == 1.0
    elsewhere = np.roll(portrait, 60, axis=1)
    assert metric(elsewhere, elsewhere.copy()) == 1.0  # it is a face there,
    assert metric(portrait, elsewhere) == 0.0  # but not the photograph's
    assert metric(portrait, np.full_like(portrait, 0.5)) == 0.0


def test_a_photograph_without_a_face_has_no_value(portrait: np.ndarray) -> None:
    for source in photographs.list_ground_textures():
        ground = (photographs.read(source.path).pixels / 255).astype(np.float32)
        assert face.PLUGIN()(ground, portrait) is None


@pytest.mark.slow
def test_of_two_faces_one_may_be_found(portrait: np.ndarray) -> None:
    beside = np.concatenate([portrait, portrait], axis=1)
    covered = beside.copy()
    covered[:, 256:] = 0.5
    assert face.PLUGIN()(beside, covered) == 0.5


@pytest.mark.slow
def test_faces_are_those_of_scikit_image(portrait: np.ndarray) -> None:
    """The detector's direct result: a box around the astronaut's face, from the hair to the chin."""
    from skimage.data import lbp_frontal_face_cascade_filename
    from skimage.feature import Cascade

    pixels = np.rint(portrait * 255).astype(np.uint8)
    (box,) = Cascade(lbp_frontal_face_cascade_filename()).detect_multi_scale(pixels, 1.1, 1.0, (32, 32), (256, 256))
    hidden = portrait.copy()
    hidden[box["r"] : box["r"] + box["height"], box["c"] : box["c"] + box["width"]] = 0.5
    assert face.PLUGIN()(portrait, hidden) == 0.0
    others = np.full_like(portrait, 0.5)
    rows, columns = slice(box["r"] - 12, box["r"] + box["height"] + 12), slice(box["c"] - 12, box["c"] + box["width"] + 12)
    others[rows, columns] = portrait[rows, columns]
    assert face.PLUGIN()(portrait, others) == 1.0


def test_faces_are_cached_by_image_and_shape(portrait: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = {"face": portrait.astype(np.float64), "grey": np.full((96, 128, 3), 0.5)}
    others = {"turned": images["face"].transpose(1, 0, 2).copy(), "grey": images["grey"].reshape(128, 96, 3)}

    def detect(image: np.ndarray) -> list[list[float]]:
        faces._detect_faces.cache_clear()  # as in another command
        found: list[list[float]] = faces.detect_faces(image).tolist()
        return found

    with store.use_folder(tmp_path):
        found = {name: detect(image) for name, image in images.items()}
        assert [len(boxes) for boxes in found.values()] == [1, 0]
        monkeypatch.setattr(faces, "_apply_detector", lambda image: np.ones((2, 4)))
        assert {name: detect(image) for name, image in images.items()} == found
        assert all(detect(image) == [[1.0] * 4] * 2 for image in others.values())
        for name, other in (("version", lambda library: "0"), ("provenance.hash_modules", lambda module: "sha256:0")):
            with monkeypatch.context() as patch:
                patch.setattr(f"bench.identification.faces.{name}", other)
                assert len(detect(images["face"])) == 2  # of another library or source
    faces._detect_faces.cache_clear()


def test_overlap_against_counted_pixels() -> None:
    rng = np.random.default_rng(4)
    one, other = (rng.integers((0, 0, 1, 1), (20, 20, 21, 21), (50, 4)) for _ in range(2))

    def pixels(box: np.ndarray) -> set[tuple[int, int]]:
        top, left, height, width = box
        return {(row, column) for row in range(top, top + height) for column in range(left, left + width)}

    expected = [len(pixels(a) & pixels(b)) / len(pixels(a) | pixels(b)) for a, b in zip(one, other, strict=True)]
    np.testing.assert_allclose(compute_overlap(one.astype(float), other.astype(float)), expected)
    assert min(expected) == 0.0 < max(expected)


@pytest.mark.parametrize("plugin", IMAGES + DESCRIPTORS)
def test_declarations(plugin: type[Metric]) -> None:
    assert plugin.compares == ("images" if plugin in IMAGES else "descriptors")
    assert plugin.unit
    assert plugin.range[0] < plugin.range[1]
    errors = {mae.PLUGIN, mse.PLUGIN, angle.PLUGIN, l2.PLUGIN}
    assert plugin.higher_is_better_for == ("defender" if plugin in errors else "attacker")
    assert plugin.summary()


@pytest.mark.parametrize("plugin", IMAGES + DESCRIPTORS)
def test_values_are_in_range_and_pure(plugin: type[Metric]) -> None:
    rng = np.random.default_rng(0)
    shape = (16, 16, 3) if plugin in IMAGES else (20, 8)
    for _ in range(10):
        truth, estimate = rng.random(shape).astype(np.float32), rng.random(shape).astype(np.float32)
        if plugin in DESCRIPTORS:
            truth, estimate = normalize_rows(truth - 0.5), normalize_rows(estimate - 0.5)
        before = truth.copy(), estimate.copy()
        value = plugin()(truth, estimate)
        assert value is None if plugin is face.PLUGIN else isinstance(value, float)  # noise has no face
        assert value is None or plugin.range[0] <= value <= plugin.range[1]
        np.testing.assert_array_equal(truth, before[0])
        np.testing.assert_array_equal(estimate, before[1])


@pytest.mark.parametrize("plugin", IMAGES)
def test_invalid_images_are_refused(plugin: type[Metric]) -> None:
    good = np.full((16, 16, 3), 0.5, dtype=np.float32)
    nan, bright = good.copy(), good * 255
    nan[3, 4, 1] = np.nan
    with pytest.raises(ValueError, match="differ in shape"):
        plugin()(good, good[:12])
    with pytest.raises(ValueError, match=r"must be \(H, W, 3\)"):
        plugin()(good[..., 0], good[..., 0])
    for wrong in (nan, bright, -good):
        with pytest.raises(ValueError, match=r"estimate: values must be in \[0, 1\]"):
            plugin()(good, wrong)
        with pytest.raises(ValueError, match=r"truth: values must be in \[0, 1\]"):
            plugin()(wrong, good)


@pytest.mark.parametrize("plugin", DESCRIPTORS)
def test_invalid_descriptors_are_refused(plugin: type[Metric]) -> None:
    good = np.eye(4, dtype=np.float32)
    nan = good.copy()
    nan[1, 1] = np.nan
    with pytest.raises(ValueError, match="differ in shape"):
        plugin()(good, good[:3])
    with pytest.raises(ValueError, match="at least 1"):
        plugin()(good[:0], good[:0])
    with pytest.raises(ValueError, match="estimate: descriptors must be finite"):
        plugin()(good, nan)
    with pytest.raises(ValueError, match="truth: descriptors must be finite"):
        plugin()(nan, good)


def test_accuracy_of_positions_is_the_area_under_the_curve() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 100, (400, 2)).astype(np.float32)
    estimate = truth + rng.normal(0, 6, truth.shape).astype(np.float32)
    errors = np.linalg.norm(truth - estimate, axis=1)
    for metric in (PositionAUC5(), PositionAUC10(), PositionAUC25()):
        distances = np.linspace(0, metric.reach, 20_001)
        within = np.searchsorted(np.sort(errors), distances, side="right") / len(errors)
        assert metric(truth, estimate) == pytest.approx(trapezoid(within, distances) / metric.reach, abs=1e-3)
        assert metric(truth, truth + np.float32(metric.reach)) == 0
    assert PositionError()(truth, estimate) == pytest.approx(np.median(errors), rel=1e-5)
    assert PositionError()(truth, truth + np.float32([3, 4])) == pytest.approx(5, rel=1e-5)
