"""The release of a mirrored and rotated photograph, derived from that of the photograph."""

import numpy as np
import pytest
import torch

from bench.api import Extractor
from bench.codebook.public import ASSETS, Public
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.images.views import PhotographView
from bench.inversion import weights
from bench.inversion.data import Examples, Target
from bench.inversion.loss import ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.reconstruct import reconstruct_image
from bench.inversion.symmetry import IDENTITY, POSITION_SYMMETRIES, Symmetry, find_symmetries
from bench.types import Descriptors, Points, Subspaces, WordSets
from defenses.none import Undefended

PIXELS = photographs.read(photographs.list_builtin()[0].path).pixels
WIDE = np.ascontiguousarray(PIXELS[:200])
EIGHT = [(mirrored, turns) for mirrored in (False, True) for turns in range(4)]


def match(found, true):
    """Return for each keypoint of `found` the keypoint of `true` with equal position and orientation, and whether it exists."""
    distances = np.linalg.norm(found.keypoints[:, None] - true.keypoints[None], axis=2)
    turned = np.abs(np.exp(1j * found.frames[:, None, 1]) - np.exp(1j * true.frames[None, :, 1]))
    return (distances + turned).argmin(axis=1), (distances + turned).min(axis=1) < 0.2


def find_symmetry(extractor, mirrored, turns):
    (symmetry,) = [one for one in find_symmetries(extractor) if (one.mirrored, one.turns) == (mirrored, turns)]
    return symmetry


def release_raw(raw):
    return Descriptors(positions=Points(keypoints=raw.keypoints), size=raw.size, descriptors=raw.descriptors)


@pytest.mark.parametrize(("mirrored", "turns"), EIGHT)
@pytest.mark.parametrize("upright", [True, False])
def test_descriptors_are_those_of_the_moved_photograph(upright, mirrored, turns):
    """The reference is SIFT of the moved photograph. Histograms shifted by one differ (negative control)."""
    extractor = Sift(upright=upright)
    symmetry = find_symmetry(extractor, mirrored, turns)
    one, true = extractor.extract(WIDE), extractor.extract(symmetry.transform_image(WIDE))
    release = Descriptors(
        positions=Points(keypoints=one.keypoints), size=one.size, descriptors=one.descriptors, frames=one.frames
    )
    found = symmetry.transform_release(release)
    assert found.size == true.size
    if upright:  # no orientation: the extractor sets it to 0
        found.frames[:, 1] = 0
    index, matched = match(found, true)
    assert matched.mean() > 0.9
    cosines = (found.descriptors * true.descriptors[index]).sum(axis=1)[matched]
    assert np.median(cosines) > 0.999
    assert cosines.mean() > 0.99
    shifted = np.roll(np.arange(128) if symmetry.order is None else symmetry.order, 8)
    wrong = Symmetry(mirrored, turns, shifted).transform_release(release)
    assert (wrong.descriptors * true.descriptors[index]).sum(axis=1)[matched].mean() < 0.75


def test_symmetries_and_their_inverses_cancel(rng):
    """Four quarter turns, or two mirrors, give the identity, for releases and for images."""
    where = {"positions": Points(keypoints=rng.uniform(0, 200, (5, 2)).astype(np.float32)), "size": (256, 200)}
    rows = rng.normal(size=(5, 3, 128)).astype(np.float32)
    for symmetry in find_symmetries(Sift()):
        again = [symmetry] if symmetry.mirrored else [symmetry] * (3 if symmetry.turns % 2 else 1)
        for release in (
            Descriptors(**where, descriptors=rows[:, 0], frames=np.full((5, 2), 0.5, np.float32)),
            Descriptors(**where, descriptors=rows[:, 0], frames=np.full((5, 1), 0.5, np.float32)),
            WordSets(**where, candidates=rows, words=None),
            Subspaces(**where, origins=rows[:, 0], bases=rows[:, 1:]),
        ):
            back = once = symmetry.transform_release(release)
            assert np.allclose(once.keypoints, release.keypoints) == ((symmetry.mirrored, symmetry.turns) == (False, 0))
            for one in again:
                back = one.transform_release(back)
            assert back.size == release.size
            for name, value in vars(release).items():
                if isinstance(value, np.ndarray):
                    found = getattr(back, name)
                    if name == "frames" and value.shape[1] == 2:
                        value, found = np.exp(1j * value), np.exp(1j * found)
                    np.testing.assert_allclose(found, value, atol=1e-4)
        moved = torch.from_numpy(symmetry.transform_image(WIDE)).permute(2, 0, 1)
        assert np.array_equal(symmetry.invert_image(moved).permute(1, 2, 0), WIDE)


def test_points_of_a_subspace_are_transformed_with_it(rng):
    symmetry = find_symmetry(Sift(), True, 1)
    origin, basis, along = rng.normal(size=(1, 128)), rng.normal(size=(1, 2, 128)), rng.normal(size=2)
    release = Subspaces(positions=Points(keypoints=np.zeros((1, 2), np.float32)), size=(9, 9), origins=origin, bases=basis)
    found = symmetry.transform_release(release)
    np.testing.assert_allclose(found.origins[0] + along @ found.bases[0], (origin[0] + along @ basis[0])[symmetry.order])


class MirrorOnly(Sift):
    """Declares no permutation for rotations."""

    turn_order = Extractor.turn_order


class IdentityOnly(MirrorOnly):
    """Declares no permutation for mirrors either."""

    mirror_order = Extractor.mirror_order


def test_only_declared_symmetries_are_used():
    assert [(one.mirrored, one.turns) for one in find_symmetries(MirrorOnly())] == [(False, 0), (True, 0)]
    assert find_symmetries(IdentityOnly()) == (IDENTITY,)
    assert {(one.mirrored, one.turns) for one in find_symmetries(Sift())} == set(EIGHT)
    with pytest.raises(TypeError, match="not defined"):
        find_symmetry(Sift(), True, 0).transform_release(Sift().extract(PIXELS))


@pytest.mark.parametrize(("mirrored", "turns"), EIGHT)
def test_the_reconstruction_is_equivariant(mirrored, turns):
    """Averaged over all eight, a transformed release gives the transformed image. With one it does not (negative control)."""
    torch.manual_seed(0)
    module = Inverter(Shape(inputs=130, widths=(8, 8, 8))).eval()
    release, eight = release_raw(Sift().extract(WIDE)), find_symmetries(Sift())
    symmetry = find_symmetry(Sift(), mirrored, turns)

    def measure_difference(symmetries):
        image, moved = (
            reconstruct_image(module, one, symmetries, np.empty(0, np.float32), 1, "invariant")
            for one in (release, symmetry.transform_release(release))
        )
        return np.abs(symmetry.transform_image(image) - moved).max()

    assert measure_difference(eight) < 1e-3  # mirrored positions are rounded
    if (mirrored, turns) != (False, 0):
        assert measure_difference([IDENTITY]) > 0.05


def test_position_symmetries_keep_descriptors():
    release = release_raw(Sift().extract(PIXELS))
    for symmetry in POSITION_SYMMETRIES:
        moved, whole = (
            symmetry.transform_release(release),
            find_symmetry(Sift(), symmetry.mirrored, symmetry.turns).transform_release(release),
        )
        assert np.array_equal(moved.keypoints, whole.keypoints)
        assert np.array_equal(moved.descriptors, release.descriptors)


@pytest.mark.slow
def test_crops_are_drawn_under_every_symmetry(rng):
    """Descriptors of a crop equal those extracted from its pixels; in another order they differ (negative control)."""

    def measure_cosines(symmetries):
        views = [PhotographView("a", PIXELS, Sift().extract(PIXELS))]
        examples = Examples(views, [Target(defense=Undefended(), supported_settings={})], {}, Public(), symmetries)
        found = []
        for _ in range(8):
            example = examples.draw(rng)
            true = Sift().extract(example.pixels)
            distances = np.linalg.norm(example.release.keypoints[:, None] - true.keypoints[None], axis=2)
            near = distances.min(axis=1) < 0.2
            assert near.mean() > 0.8
            found.append((example.release.descriptors * true.descriptors[distances.argmin(axis=1)]).sum(axis=1)[near].mean())
        return np.array(found)

    assert (measure_cosines(find_symmetries(Sift())) > 0.9).all()
    confused = [Symmetry(one.mirrored, one.turns, None) for one in find_symmetries(Sift())]
    assert measure_cosines(confused).min() < 0.7


@pytest.mark.slow
def test_averaging_over_symmetries_improves_the_shipped_network():
    """The mean SSIM of three photographs improves; with a wrong order of the components it gets worse (negative control)."""
    module = weights.load(ASSETS / "inversion-none.safetensors").module
    upright = find_symmetries(Sift())
    variants = {
        "once": (IDENTITY,),
        "twice": (IDENTITY, find_symmetry(Sift(), True, 0)),
        "eight": upright,
        "wrong": find_symmetries(Sift(upright=False)),
    }
    scores = dict.fromkeys(variants, 0.0)
    for source in photographs.list_builtin()[:3]:
        pixels = photographs.read(source.path).pixels
        release = release_raw(Sift().extract(pixels))
        truth = torch.from_numpy(pixels).permute(2, 0, 1) / 255
        for name, symmetries in variants.items():
            image = reconstruct_image(module, release, symmetries, np.empty(0, np.float32), 1, "invariant")
            scores[name] += float(ssim(torch.from_numpy(image).permute(2, 0, 1), truth))
    assert scores["eight"] > scores["twice"] > scores["once"] > scores["wrong"]
