"""The release of a mirrored photograph, made from that of the photograph."""

import numpy as np
import pytest
import torch

from attacks.inversion import weights
from attacks.inversion.loss import ssim
from attacks.inversion.mirror import elsewhere, mirrored
from attacks.inversion.network import Inverter, Shape
from attacks.inversion.painting import painted
from bench.datasets import photographs
from bench.features.sift import Sift
from bench.plugin import Extractor
from bench.public import ASSETS
from bench.types import Descriptors, Subspaces, WordSets

PIXELS = photographs.read(photographs.builtin()[0].path).pixels


def nearest(found, true):
    """For each keypoint of `found` that of `true` at its place and with its orientation, and whether there is one."""
    apart = np.linalg.norm(found.keypoints[:, None] - true.keypoints[None], axis=2)
    turned = np.abs(np.exp(1j * found.frames[:, None, 1]) - np.exp(1j * true.frames[None, :, 1]))
    return (apart + turned).argmin(axis=1), (apart + turned).min(axis=1) < 0.2


@pytest.mark.parametrize("upright", [True, False])
def test_descriptors_are_those_of_the_mirrored_photograph(upright):
    """SIFT of the mirrored photograph is the reference; the other kind's order is not it (control)."""
    extractor = Sift(upright=upright)
    one, other = extractor.extract(PIXELS), extractor.extract(np.ascontiguousarray(PIXELS[:, ::-1]))
    release = Descriptors(keypoints=one.keypoints, size=one.size, descriptors=one.descriptors, frames=one.frames)
    found = mirrored(release, extractor.mirror_order())
    if upright:  # has no orientation: the extractor calls it 0, mirrored or not
        found.frames[:, 1] = 0
    place, there = nearest(found, other)
    assert there.mean() > 0.9
    cosines = (found.descriptors * other.descriptors[place]).sum(axis=1)[there]
    assert np.median(cosines) > 0.999
    assert cosines.mean() > 0.99
    wrong = mirrored(release, Sift(upright=not upright).mirror_order())
    assert (wrong.descriptors * other.descriptors[place]).sum(axis=1)[there].mean() < 0.7


def test_twice_mirrored_is_as_it_was(rng):
    order = Sift().mirror_order()
    where = {"keypoints": rng.uniform(0, 256, (5, 2)).astype(np.float32), "size": (256, 256)}
    rows = rng.normal(size=(5, 3, 128)).astype(np.float32)
    for release in (
        Descriptors(**where, descriptors=rows[:, 0], frames=np.full((5, 2), 0.5, np.float32)),
        Descriptors(**where, descriptors=rows[:, 0], frames=np.full((5, 1), 0.5, np.float32)),
        WordSets(**where, candidates=rows, words=None),
        Subspaces(**where, origins=rows[:, 0], bases=rows[:, 1:]),
    ):
        once, twice = mirrored(release, order), mirrored(mirrored(release, order), order)
        assert not np.allclose(once.keypoints, release.keypoints)
        for name, value in vars(release).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(getattr(twice, name), value, atol=1e-4)


def test_points_of_a_subspace_are_mirrored_with_it(rng):
    order = Sift().mirror_order()
    origin, basis, along = rng.normal(size=(1, 128)), rng.normal(size=(1, 2, 128)), rng.normal(size=2)
    release = Subspaces(keypoints=np.zeros((1, 2), np.float32), size=(9, 9), origins=origin, bases=basis)
    found = mirrored(release, order)
    np.testing.assert_allclose(found.origins[0] + along @ found.bases[0], (origin[0] + along @ basis[0])[order])


def test_what_is_not_known_is_said():
    assert Extractor.mirror_order(Sift()) is None  # of an extractor that says nothing of it
    with pytest.raises(TypeError, match="not defined"):
        mirrored(Sift().extract(PIXELS), Sift().mirror_order())


def test_what_is_painted_twice_is_the_same_of_the_mirrored_photograph(rng):
    """Of a release and its mirror image comes one image and its mirror image. Not so of one alone (control)."""
    torch.manual_seed(0)
    module = Inverter(Shape(inputs=130, widths=(8, 8, 8))).eval()
    raw = Sift().extract(PIXELS)
    release = Descriptors(keypoints=raw.keypoints, size=raw.size, descriptors=raw.descriptors)
    mirror = mirrored(release, Sift().mirror_order())
    known = np.empty(0, np.float32)

    def shown(one, other):
        return painted(module, one, other, known, 1, "invariant")

    np.testing.assert_allclose(shown(release, mirror), shown(mirror, release)[:, ::-1], atol=1e-6)
    np.testing.assert_allclose(shown(release, mirror), (shown(release, None) + shown(mirror, None)[:, ::-1]) / 2, atol=1e-2)
    assert np.abs(shown(release, None) - shown(mirror, None)[:, ::-1]).max() > 0.05


def test_positions_are_mirrored_alone(rng):
    raw = Sift().extract(PIXELS)
    release = Descriptors(keypoints=raw.keypoints, size=raw.size, descriptors=raw.descriptors)
    moved, whole = elsewhere(release), mirrored(release, Sift().mirror_order())
    assert np.array_equal(moved.keypoints, whole.keypoints)
    assert np.array_equal(moved.descriptors, release.descriptors)


def test_the_shipped_network_paints_better_twice():
    """Mean SSIM over three photographs; with the components of the mirrored descriptors in a wrong order, worse (control)."""
    module = weights.load(ASSETS / "inversion-none.safetensors").module
    scores = {"once": 0.0, "twice": 0.0, "wrong": 0.0}
    for source in photographs.builtin()[:3]:
        pixels = photographs.read(source.path).pixels
        raw = Sift().extract(pixels)
        release = Descriptors(keypoints=raw.keypoints, size=raw.size, descriptors=raw.descriptors)
        mirrors = {
            "once": None,
            "twice": mirrored(release, Sift().mirror_order()),
            "wrong": mirrored(release, Sift(upright=False).mirror_order()),
        }
        truth = torch.from_numpy(pixels).permute(2, 0, 1) / 255
        for name, mirror in mirrors.items():
            shown = painted(module, release, mirror, np.empty(0, np.float32), 1, "invariant")
            scores[name] += float(ssim(torch.from_numpy(shown).permute(2, 0, 1), truth))
    assert scores["twice"] > scores["once"] > scores["wrong"]
