"""The release of a mirrored and turned photograph, made from that of the photograph."""

import numpy as np
import pytest
import torch

from bench.api import Extractor
from bench.codebook.public import ASSETS, Public
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.images.views import PhotographView
from bench.inversion import weights
from bench.inversion.data import Examples
from bench.inversion.loss import ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.reconstruct import painted
from bench.inversion.symmetry import IDENTITY, OF_POSITIONS, Symmetry, symmetries
from bench.types import Descriptors, Subspaces, WordSets
from defenses.none import Undefended

PIXELS = photographs.read(photographs.builtin()[0].path).pixels
WIDE = np.ascontiguousarray(PIXELS[:200])
EIGHT = [(mirrored, turns) for mirrored in (False, True) for turns in range(4)]


def nearest(found, true):
    """For each keypoint of `found` that of `true` at its place and with its orientation, and whether there is one."""
    apart = np.linalg.norm(found.keypoints[:, None] - true.keypoints[None], axis=2)
    turned = np.abs(np.exp(1j * found.frames[:, None, 1]) - np.exp(1j * true.frames[None, :, 1]))
    return (apart + turned).argmin(axis=1), (apart + turned).min(axis=1) < 0.2


def of(extractor, mirrored, turns):
    (found,) = [one for one in symmetries(extractor) if (one.mirrored, one.turns) == (mirrored, turns)]
    return found


def undefended(raw):
    return Descriptors(keypoints=raw.keypoints, size=raw.size, descriptors=raw.descriptors)


@pytest.mark.parametrize(("mirrored", "turns"), EIGHT)
@pytest.mark.parametrize("upright", [True, False])
def test_descriptors_are_those_of_the_moved_photograph(upright, mirrored, turns):
    """SIFT of the moved photograph is the reference; with each histogram in its neighbour's place, it is not (control)."""
    extractor = Sift(upright=upright)
    symmetry = of(extractor, mirrored, turns)
    one, true = extractor.extract(WIDE), extractor.extract(symmetry.of_image(WIDE))
    release = Descriptors(keypoints=one.keypoints, size=one.size, descriptors=one.descriptors, frames=one.frames)
    found = symmetry.of_release(release)
    assert found.size == true.size
    if upright:  # has no orientation: the extractor calls it 0, however the photograph lies
        found.frames[:, 1] = 0
    place, there = nearest(found, true)
    assert there.mean() > 0.9
    cosines = (found.descriptors * true.descriptors[place]).sum(axis=1)[there]
    assert np.median(cosines) > 0.999
    assert cosines.mean() > 0.99
    shifted = np.roll(np.arange(128) if symmetry.order is None else symmetry.order, 8)
    wrong = Symmetry(mirrored, turns, shifted).of_release(release)
    assert (wrong.descriptors * true.descriptors[place]).sum(axis=1)[there].mean() < 0.75


def test_what_was_moved_comes_back(rng):
    """Four quarter turns, and two mirrors, are nothing; so it is with images, which are moved back."""
    where = {"keypoints": rng.uniform(0, 200, (5, 2)).astype(np.float32), "size": (256, 200)}
    rows = rng.normal(size=(5, 3, 128)).astype(np.float32)
    for symmetry in symmetries(Sift()):
        again = [symmetry] if symmetry.mirrored else [symmetry] * (3 if symmetry.turns % 2 else 1)
        for release in (
            Descriptors(**where, descriptors=rows[:, 0], frames=np.full((5, 2), 0.5, np.float32)),
            Descriptors(**where, descriptors=rows[:, 0], frames=np.full((5, 1), 0.5, np.float32)),
            WordSets(**where, candidates=rows, words=None),
            Subspaces(**where, origins=rows[:, 0], bases=rows[:, 1:]),
        ):
            back = once = symmetry.of_release(release)
            assert np.allclose(once.keypoints, release.keypoints) == ((symmetry.mirrored, symmetry.turns) == (False, 0))
            for one in again:
                back = one.of_release(back)
            assert back.size == release.size
            for name, value in vars(release).items():
                if isinstance(value, np.ndarray):
                    found = getattr(back, name)
                    if name == "frames" and value.shape[1] == 2:
                        value, found = np.exp(1j * value), np.exp(1j * found)
                    np.testing.assert_allclose(found, value, atol=1e-4)
        moved = torch.from_numpy(symmetry.of_image(WIDE)).permute(2, 0, 1)
        assert np.array_equal(symmetry.undone(moved).permute(1, 2, 0), WIDE)


def test_points_of_a_subspace_are_moved_with_it(rng):
    symmetry = of(Sift(), True, 1)
    origin, basis, along = rng.normal(size=(1, 128)), rng.normal(size=(1, 2, 128)), rng.normal(size=2)
    release = Subspaces(keypoints=np.zeros((1, 2), np.float32), size=(9, 9), origins=origin, bases=basis)
    found = symmetry.of_release(release)
    np.testing.assert_allclose(found.origins[0] + along @ found.bases[0], (origin[0] + along @ basis[0])[symmetry.order])


class Silent(Sift):
    """Says nothing of turned photographs."""

    turn_order = Extractor.turn_order


class Mute(Silent):
    """Nor of mirrored ones."""

    mirror_order = Extractor.mirror_order


def test_what_is_not_known_is_not_done():
    assert [(one.mirrored, one.turns) for one in symmetries(Silent())] == [(False, 0), (True, 0)]
    assert symmetries(Mute()) == (IDENTITY,)
    assert {(one.mirrored, one.turns) for one in symmetries(Sift())} == set(EIGHT)
    with pytest.raises(TypeError, match="not defined"):
        of(Sift(), True, 0).of_release(Sift().extract(PIXELS))


@pytest.mark.parametrize(("mirrored", "turns"), EIGHT)
def test_what_is_painted_does_not_depend_on_how_the_photograph_lies(mirrored, turns):
    """Of a moved release comes the moved image, where all eight are painted. Not so of one alone (control)."""
    torch.manual_seed(0)
    module = Inverter(Shape(inputs=130, widths=(8, 8, 8))).eval()
    release, eight = undefended(Sift().extract(WIDE)), symmetries(Sift())
    symmetry = of(Sift(), mirrored, turns)

    def apart(seen):
        image, moved = (
            painted(module, one, seen, np.empty(0, np.float32), 1, "invariant") for one in (release, symmetry.of_release(release))
        )
        return np.abs(symmetry.of_image(image) - moved).max()

    assert apart(eight) < 1e-3  # positions are rounded where they are taken from the other side
    if (mirrored, turns) != (False, 0):
        assert apart([IDENTITY]) > 0.05


def test_positions_are_moved_alone():
    release = undefended(Sift().extract(PIXELS))
    for alone in OF_POSITIONS:
        moved, whole = alone.of_release(release), of(Sift(), alone.mirrored, alone.turns).of_release(release)
        assert np.array_equal(moved.keypoints, whole.keypoints)
        assert np.array_equal(moved.descriptors, release.descriptors)


def test_crops_are_drawn_under_every_symmetry(rng):
    """Descriptors of a crop are what is extracted from its pixels, however it lies; of another order they are not (control)."""

    def cosine(known):
        views = [PhotographView("a", PIXELS, Sift().extract(PIXELS))]
        examples = Examples(views, Undefended(), {}, {}, Public(), known)
        found = []
        for _ in range(8):
            example = examples.draw(rng)
            true = Sift().extract(example.pixels)
            apart = np.linalg.norm(example.release.keypoints[:, None] - true.keypoints[None], axis=2)
            near = apart.min(axis=1) < 0.2
            assert near.mean() > 0.8
            found.append((example.release.descriptors * true.descriptors[apart.argmin(axis=1)]).sum(axis=1)[near].mean())
        return np.array(found)

    assert (cosine(symmetries(Sift())) > 0.9).all()
    confused = [Symmetry(one.mirrored, one.turns, None) for one in symmetries(Sift())]
    assert cosine(confused).min() < 0.7


def test_the_shipped_network_paints_better_eight_times():
    """Mean SSIM over three photographs; with the components of the moved descriptors in a wrong order, worse (control)."""
    module = weights.load(ASSETS / "inversion-none.safetensors").module
    upright = symmetries(Sift())
    seen = {
        "once": (IDENTITY,),
        "twice": (IDENTITY, of(Sift(), True, 0)),
        "eight": upright,
        "wrong": symmetries(Sift(upright=False)),
    }
    scores = dict.fromkeys(seen, 0.0)
    for source in photographs.builtin()[:3]:
        pixels = photographs.read(source.path).pixels
        release = undefended(Sift().extract(pixels))
        truth = torch.from_numpy(pixels).permute(2, 0, 1) / 255
        for name, known in seen.items():
            image = painted(module, release, known, np.empty(0, np.float32), 1, "invariant")
            scores[name] += float(ssim(torch.from_numpy(image).permute(2, 0, 1), truth))
    assert scores["eight"] > scores["twice"] > scores["once"] > scores["wrong"]
