"""The inversion network: encoding, loss, exact resumption of training, weights, and the rule about dictionaries."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from fakes import interrupted_training
from skimage.metrics import structural_similarity

from attacks.dia import DIA
from attacks.dia_lines import DIALines
from attacks.generative import Generative
from bench.cli import main
from bench.codebook import build, dictionary
from bench.codebook.public import ASSETS, Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import WordIndex
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.views import LazyViews, collect_views
from bench.inversion import data, weights
from bench.inversion.data import Target
from bench.inversion.encoding import EncodedRelease, encode, encode_settings, stack
from bench.inversion.loss import reconstruction_loss, ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Plan, Training
from bench.inversion.reconstruct import infer
from bench.inversion.train import check_quantisation, train
from bench.settings import Asset, Between, OneOf
from bench.types import Descriptors, Points, Subspaces, WordSets
from defenses.affine import Affine, reparameterise
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.naive_ldp import NaiveLDP
from defenses.none import Undefended
from defenses.plateau import Plateau
from defenses.privunit import PrivUnit

TINY = Training(steps=4, batch=2, warmup=2)

pytestmark = pytest.mark.usefixtures("narrow_networks")


@pytest.fixture(scope="module")
def sources():
    return photographs.list_builtin()


@pytest.fixture(scope="module")
def album(sources, tmp_path_factory):
    """Two photographs to train on, in a folder."""
    folder = tmp_path_factory.mktemp("album")
    for source in sources[:2]:
        (folder / source.path.name).write_bytes(source.path.read_bytes())
    return folder


@pytest.fixture(scope="module")
def words(album, tmp_path_factory):
    """A dictionary built from the two photographs of the album."""
    path = tmp_path_factory.mktemp("k") / "K.safetensors"
    build.build(album, 3000, path, Sift(), seed=0)
    return Asset(path)


def draw_releases(rng, count=5):
    common = {"positions": Points(keypoints=rng.uniform(0, 256, (count, 2)).astype(np.float32)), "size": (256, 256)}
    unit = rng.normal(size=(count, 3, 128)).astype(np.float32)
    return [
        Descriptors(**common, descriptors=unit[:, 0]),
        WordSets(**common, candidates=unit, words=None),
        Subspaces(**common, origins=unit[:, 0], bases=unit[:, 1:]),
    ]


def test_every_kind_of_release_has_a_stacking(rng):
    assert [stack(release, "invariant").shape[1] for release in draw_releases(rng)] == [1, 3, 17]
    with pytest.raises(TypeError, match="no stacking"):
        stack(object(), "invariant")


def test_the_stacking_of_subspaces_depends_on_the_subspace_and_not_on_its_basis(rng):
    """Two re-parameterisations of one D stack alike; two different D do not (negative control)."""
    d = rng.normal(size=(20, 128))
    span = np.linalg.qr(rng.normal(size=(20, 128, 6)))[0].transpose(0, 2, 1)
    common = {"positions": Points(keypoints=np.zeros((20, 2), np.float32)), "size": (256, 256)}

    def stack_subspaces(point):
        origins, bases = reparameterise(point, span, rng)
        return stack(Subspaces(**common, origins=origins, bases=bases), "invariant")

    first = stack_subspaces(d)
    np.testing.assert_allclose(first, stack_subspaces(d), atol=1e-5)
    np.testing.assert_allclose(first, stack_subspaces(d + rng.normal(size=(20, 1)) * span[:, 0]), atol=1e-5)
    assert np.abs(first - stack_subspaces(rng.normal(size=(20, 128)))).max() > 0.1


def test_the_stacking_of_the_paper_depends_on_the_random_basis(rng):
    d, span = rng.normal(size=(20, 128)), np.linalg.qr(rng.normal(size=(20, 128, 6)))[0].transpose(0, 2, 1)
    common = {"positions": Points(keypoints=np.zeros((20, 2), np.float32)), "size": (256, 256)}

    def stack_released():
        origins, bases = reparameterise(d, span, rng)
        return stack(Subspaces(**common, origins=origins, bases=bases), "released")

    assert stack_released().shape == (20, 1 + 6, 128)
    assert np.abs(stack_released() - stack_released()).max() > 0.1


def test_positions_alone_encode_no_descriptor(rng):
    first, second, third = (encode([release], [np.empty(0, np.float32)], 0, "positions") for release in draw_releases(rng))
    assert first.values.shape == (5, 2)
    assert torch.equal(first.values, second.values)
    assert torch.equal(first.values, third.values)


def test_released_frames_are_encoded(rng):
    release = draw_releases(rng)[0]
    framed = dataclasses.replace(release, frames=np.array([[8.0, np.pi / 2]] * 5, np.float32))
    values = encode([framed], [np.ones(1, np.float32)], 1, "invariant").values
    np.testing.assert_allclose(values[:, 130:], [[1, 0, 1, 1]] * 5, atol=1e-6)  # an octave over 4 pixels, cosine, sine; condition
    scaled = dataclasses.replace(framed, frames=framed.frames[:, :1])
    assert encode([scaled], [np.ones(1, np.float32)], 1, "invariant").values.shape == (5, 128 + 2 + 1 + 1)


@pytest.mark.slow
def test_a_set_network_ignores_order_and_padding(rng):
    release = draw_releases(rng)[1]
    shuffled = dataclasses.replace(release, candidates=release.candidates[:, ::-1])
    settings = [np.ones(1, np.float32)]

    def run(network, release, slots):
        return network(encode([release], settings, slots, "invariant"))

    torch.manual_seed(0)
    set_network = Inverter(Shape(inputs=4 * 128 + 3, candidates=4, length=128)).eval()
    torch.testing.assert_close(run(set_network, release, 4), run(set_network, shuffled, 4))
    fewer = Inverter(Shape(inputs=3 * 128 + 3, candidates=3, length=128)).eval()
    fewer.load_state_dict(set_network.state_dict())
    torch.testing.assert_close(run(fewer, release, 3), run(set_network, release, 4))
    stack_network = Inverter(Shape(inputs=4 * 128 + 3)).eval()  # negative control
    assert not torch.allclose(run(stack_network, release, 4), run(stack_network, shuffled, 4), atol=1e-4)


def test_encoding_pads_candidates_and_computes_cells(rng):
    release = draw_releases(rng)[1]
    points = encode([release, release], [np.array([0.25], np.float32)] * 2, slots=4, encoding="invariant")
    assert points.values.shape == (10, 4 * 128 + 2 + 1)
    assert (points.values[:, 3 * 128 : 4 * 128] == 0).all()
    assert (points.values[:, -1] == 0.25).all()
    row, column = int(release.keypoints[0, 1] // 4), int(release.keypoints[0, 0] // 4)
    assert points.coordinates[0].long().tolist() == [column, row]
    assert points.image.tolist() == [0] * 5 + [1] * 5
    assert points.grid == (64, 64)
    with pytest.raises(ValueError, match="at most 2"):
        encode([release], [np.empty(0, np.float32)], slots=2, encoding="invariant")


def test_keypoints_on_the_border_stay_in_the_grid():
    corners = np.array([[0, 0], [256, 256], [-1, 300]], np.float32)
    release = Descriptors(positions=Points(keypoints=corners), size=(256, 256), descriptors=np.zeros((3, 128), np.float32))
    points = encode([release], [np.empty(0, np.float32)], slots=1, encoding="invariant")
    assert points.coordinates.long().tolist() == [[0, 0], [63, 63], [0, 63]]


def test_settings_are_encoded_by_their_supported_range():
    supported = {"epsilon": Between(8.0, 16.0), "subset_size": OneOf((1, 2, 3, 4))}
    assert np.allclose(encode_settings(LDP(epsilon=10, subset_size=4), 0, [supported]), [0.25, 1.0])
    assert encode_settings(Undefended(), 0, [{}]).shape == (0,)


def scatter(net, values, coordinates, size=(64, 48)):
    with torch.inference_mode():
        image = torch.zeros(len(values), dtype=torch.int64)
        points = EncodedRelease(values=values, coordinates=coordinates, image=image, batch=1, size=size)
        return net.scatter(points)[0]  # (C, H/4, W/4)


@pytest.mark.parametrize("patch", [5, 6])
def test_keypoints_that_share_a_cell_are_summed(patch, rng):
    """The rule of `network.py` holds in any order of keypoints. Patches reach equally far on all sides, and not outside."""
    net, counts = Inverter(Shape(inputs=130, widths=(9, 9), patch=patch, painted=2)).eval(), 8  # index of the count channel
    values = torch.from_numpy(rng.normal(size=(3, 130)).astype(np.float32))
    coordinates = torch.tensor([[7.3, 1.8], [7.6, 1.2], [0.2, 15.7]])
    grid = scatter(net, values, coordinates)
    expected = torch.zeros(16, 12, counts + 3)
    with torch.inference_mode():
        hidden = net.embed(values)
        own, around = net.own(hidden), net.around(hidden).view(3, patch, patch, 2)
    for keypoint, (x, y) in enumerate(coordinates.tolist()):
        expected[int(y), int(x), :counts] += own[keypoint]
        expected[int(y), int(x), counts] += 1
        for row in range(patch):
            for column in range(patch):
                # The patch's middle is the keypoint, to half a cell.
                down, right = int(np.floor(y - (patch - 1) / 2)) + row, int(np.floor(x - (patch - 1) / 2)) + column
                if 0 <= down < 16 and 0 <= right < 12:
                    expected[down, right, counts + 1 :] += around[keypoint, row, column]
    torch.testing.assert_close(grid, expected.permute(2, 0, 1), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(scatter(net, values.flip(0), coordinates.flip(0)), grid, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(scatter(net, values.flip(0), coordinates), grid, atol=1e-2)  # control: the coordinates matter


@pytest.mark.parametrize("size", [(256, 256), (255, 130), (7, 1)])
def test_an_image_of_any_size_is_reconstructed(size, rng):
    height, width = size
    release = Descriptors(
        positions=Points(keypoints=rng.uniform(0, (width, height), (5, 2)).astype(np.float32)),
        size=(width, height),
        descriptors=rng.normal(size=(5, 128)).astype(np.float32),
    )
    points = encode([release], [np.empty(0, np.float32)], slots=1, encoding="invariant")
    assert infer(Inverter(Shape(inputs=130, widths=(8, 8, 8))).eval(), points).shape == (1, 3, height, width)


def test_ssim_of_the_loss_is_scikit_images(rng):
    a, b = rng.random((2, 64, 64)).astype(np.float32)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    full = structural_similarity(a, b, full=True, **settings)[1][5:-5, 5:-5].mean()
    ours = float(ssim(torch.from_numpy(a)[None], torch.from_numpy(b)[None]))
    assert ours == pytest.approx(full, abs=1e-5)
    other = structural_similarity(a, b, full=True, **settings | {"sigma": 1.0})[1][5:-5, 5:-5].mean()
    assert ours != pytest.approx(other, abs=1e-4)  # negative control: the comparison distinguishes settings


@pytest.mark.parametrize("size", [(64, 64), (11, 130), (256, 61)])
def test_gradient_of_the_loss_is_that_of_convolutions(size, rng):
    image, photograph = (torch.from_numpy(rng.random((2, 3, *size)).astype(np.float32)) for _ in range(2))

    def convolve(images, sigma=1.5):
        taps = torch.exp(-(torch.arange(-5, 6) ** 2) / (2 * sigma**2))
        taps = (taps / taps.sum())[None, None]
        return torch.nn.functional.conv2d(torch.nn.functional.conv2d(images[:, None], taps[..., None, :]), taps[..., None])[:, 0]

    def reference(image, sigma=1.5):
        a, b = ((0.299 * x[:, 0] + 0.587 * x[:, 1] + 0.114 * x[:, 2]) for x in (image, photograph))
        mean_a, mean_b, aa, bb, ab = (convolve(x, sigma) for x in (a, b, a * a, b * b, a * b))
        numerator = (2 * mean_a * mean_b + 0.01**2) * (2 * (ab - mean_a * mean_b) + 0.03**2)
        denominator = (mean_a**2 + mean_b**2 + 0.01**2) * (aa - mean_a**2 + bb - mean_b**2 + 0.03**2)
        return torch.nn.functional.l1_loss(image, photograph) + 0.3 * (1 - (numerator / denominator).mean())

    def differentiate(loss):
        leaf = image.clone().requires_grad_()
        loss(leaf).backward()
        return leaf.grad

    gradient = differentiate(lambda image: reconstruction_loss(image, photograph))
    torch.testing.assert_close(gradient, differentiate(reference), rtol=1e-3, atol=1e-8)
    assert not torch.allclose(gradient, differentiate(lambda image: reference(image, 1.6)), rtol=1e-3, atol=1e-8)  # control


def test_the_loss_allows_any_factor_and_autocast(rng):
    image, photograph = (torch.from_numpy(rng.random((1, 3, 64, 64)).astype(np.float32)) for _ in range(2))
    gradients = []
    for factor, autocast in ((1, False), (-2, False), (1, True)):
        leaf = image.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            loss = factor * reconstruction_loss(leaf, photograph)
        loss.backward()
        gradients.append(leaf.grad)
    torch.testing.assert_close(gradients[1], -2 * gradients[0])
    torch.testing.assert_close(gradients[2], gradients[0])
    with pytest.raises(ValueError, match="at least 11 pixels a side, got 10"):
        reconstruction_loss(image[:, :, :10], photograph[:, :, :10])


def test_loss_of_the_truth_is_zero(rng):
    image = torch.from_numpy(rng.random((1, 3, 64, 64)).astype(np.float32))
    assert float(reconstruction_loss(image, image)) == pytest.approx(0, abs=1e-6)
    assert float(reconstruction_loss(1 - image, image)) > 0.1


def fix(defense):
    """Return a target without random settings."""
    return Target(defense=defense, supported_settings={})


def build_plan(sources, **given):
    """A training on two photographs, validated on a third."""
    data = {"photographs": sources[:2], "validation": sources[2:3], "extractor": Sift(), "widths": (8, 8)}
    return Plan(**{"targets": [fix(Undefended())]} | data | given)


@pytest.mark.slow
@pytest.mark.parametrize("defense", [Undefended(), pytest.param(Affine(lifting="random", dim=2), marks=pytest.mark.exhaustive)])
def test_a_resumed_training_is_the_same_training(defense, sources, tmp_path, monkeypatch):
    import bench.inversion.train as module

    monkeypatch.setattr(module, "CHECKPOINT_EVERY", 2)
    plan = build_plan(sources, targets=[fix(defense)], training=TINY)
    whole = train(plan, tmp_path / "whole.safetensors")
    # Interrupt the second one after its third step, which is lost.
    with interrupted_training(after=3):
        train(plan, tmp_path / "parts.safetensors")
    parts = train(plan, tmp_path / "parts.safetensors")
    a, b = weights.load(tmp_path / "whole.safetensors"), weights.load(tmp_path / "parts.safetensors")
    assert a.digest == b.digest
    assert whole["validation"] == parts["validation"]
    other = train(dataclasses.replace(plan, training=dataclasses.replace(TINY, seed=1)), tmp_path / "other.safetensors")
    assert other["validation"] != whole["validation"]  # negative control


@pytest.mark.slow
@pytest.mark.parametrize(
    "defense", [Undefended(), pytest.param(LDP(epsilon=8, subset_size=2, words=2000), marks=pytest.mark.exhaustive)]
)
def test_views_on_demand_train_the_same_network(defense, sources, tmp_path, monkeypatch):
    """Views that do not fit into memory are read repeatedly, with the same result."""
    import bench.inversion.train as module

    plan = build_plan(sources, targets=[fix(defense)], training=TINY)
    in_memory = train(plan, tmp_path / "in-memory.safetensors")
    monkeypatch.setattr(module, "MAX_IN_MEMORY", 1)
    on_demand = train(plan, tmp_path / "on-demand.safetensors")
    assert on_demand == in_memory
    assert weights.load(tmp_path / "in-memory.safetensors").digest == weights.load(tmp_path / "on-demand.safetensors").digest


@pytest.mark.slow
def test_views_on_demand_skip_unreadable_files(sources, tmp_path, rng):
    unreadable = Source("unreadable", tmp_path / "unreadable.png")
    unreadable.path.write_bytes(b"no picture")
    lazy, eager = LazyViews([unreadable, sources[0]], Sift()), collect_views([unreadable, sources[0]], Sift())
    assert [len(lazy), len(lazy[::4]), len(list(lazy)), len(eager)] == [8, 2, 4, 4]
    for one, other in zip(lazy, eager, strict=True):
        assert one.photograph == other.photograph
        assert np.array_equal(one.pixels, other.pixels)
        assert np.array_equal(one.features.codes, other.features.codes)
    assert data.Examples(lazy, [fix(Undefended())], {}, Public()).draw(rng).pixels.shape == (256, 256, 3)
    with pytest.raises(UserError, match="none of 100"):
        data.Examples(lazy[:4], [fix(Undefended())], {}, Public()).draw(rng)


@pytest.mark.parametrize(("slots", "candidates"), [(1, 1), (3, 1), (4, 4)])
def test_a_network_initialised_from_one_for_raw_descriptors_gives_the_same_image(slots, candidates, rng):
    """A release whose first slot holds the descriptor gives the image of the network for raw descriptors."""
    trained, fresh = Inverter(Shape(inputs=130)).eval(), Inverter(Shape(inputs=slots * 128 + 2 + 1)).eval()
    weights.initialise_from(fresh, trained, candidates)
    raw = draw_releases(rng)[0]
    rows = np.zeros((len(raw), slots, 128), np.float32)
    rows[:, 0] = raw.descriptors * np.float32(candidates**0.5)
    padded = WordSets(positions=Points(keypoints=raw.keypoints), size=raw.size, candidates=rows, words=None)
    found = fresh(encode([padded], [np.ones(1, np.float32)], slots, "invariant"))
    expected = trained(encode([raw], [np.empty(0, np.float32)], 1, "invariant"))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(
        Inverter(Shape(inputs=130)).eval()(encode([raw], [np.empty(0, np.float32)], 1, "invariant")), expected, atol=1e-2
    )


@pytest.mark.parametrize(
    "shape", [Shape(inputs=2), Shape(inputs=3 * 128 + 3), Shape(inputs=4 * 128 + 3, candidates=4, length=128)], ids=str
)
def test_a_network_initialised_from_one_for_the_same_releases_is_equal(shape):
    """All slots and settings are copied. Narrower levels take the first channels."""
    trained, fresh = Inverter(shape), Inverter(shape)
    weights.initialise_from(fresh, trained, max(1, shape.candidates))
    assert all(torch.equal(value, fresh.state_dict()[name]) for name, value in trained.state_dict().items())
    narrow = Inverter(dataclasses.replace(shape, widths=(32, 64, 56, 48)))
    weights.initialise_from(narrow, trained, max(1, shape.candidates))
    for name, value in narrow.state_dict().items():
        assert torch.equal(value, trained.state_dict()[name][tuple(map(slice, value.shape))])
    with pytest.raises(UserError, match="other sizes"):
        weights.initialise_from(trained, narrow, max(1, shape.candidates))
    other = Inverter(dataclasses.replace(shape, inputs=2 * 128 + 3, candidates=0, length=0))  # of fewer slots
    with pytest.raises(UserError, match="is for other releases"):
        weights.initialise_from(other, trained, 1)


@pytest.mark.parametrize("sizes", [{"inputs": 66}, {"inputs": 130}, {"inputs": 4 * 64 + 3, "candidates": 4}], ids=str)
def test_a_network_initialised_from_one_for_other_features_has_a_new_first_layer(sizes):
    trained, module = Inverter(Shape(inputs=130, length=128)), Inverter(Shape(**sizes, length=64))
    before = module.embed[0].weight.clone()
    weights.initialise_from(module, trained, 1)
    assert torch.equal(module.embed[0].weight, before)
    copied = {name: value for name, value in module.state_dict().items() if name != "embed.0.weight"}
    assert all(torch.equal(value, trained.state_dict()[name]) for name, value in copied.items())


@pytest.mark.slow
def test_training_learns(sources, tmp_path):
    """Forty steps on two photographs reduce the loss well below that of the first step."""
    import bench.inversion.train as module

    losses = []

    class Watched(module._Trainer):
        def _advance(self, *given):
            losses.append(super()._advance(*given))
            return losses[-1]

    original, module._Trainer = module._Trainer, Watched
    try:
        train(build_plan(sources, training=Training(steps=40, batch=2, warmup=5)), tmp_path / "W")
    finally:
        module._Trainer = original
    assert np.mean(losses[-5:]) < 0.75 * np.mean(losses[:5])


@pytest.mark.slow
def test_a_checkpoint_of_another_training_is_refused(sources, tmp_path, monkeypatch):
    import bench.inversion.train as module

    plan, out = build_plan(sources, training=TINY), tmp_path / "W.safetensors"
    monkeypatch.setattr(module.weights, "save", lambda *_: (_ for _ in ()).throw(OSError("the disk is full")))
    with pytest.raises(OSError, match="disk"):
        train(plan, out)
    with pytest.raises(UserError, match="another training"):
        train(dataclasses.replace(plan, training=dataclasses.replace(TINY, seed=1)), out)


def test_photographs_in_both_sets_are_refused(sources, tmp_path):
    with pytest.raises(UserError, match="in both"):
        train(dataclasses.replace(build_plan(sources), validation=sources[1:2]), tmp_path / "W")


@pytest.mark.slow
def test_photographs_of_a_dictionary_quantise_to_nearly_themselves(sources, words):
    """Negative control of the rule: training photographs that the dictionary was built from fail the check."""
    public = Public()
    own, unseen = collect_views(sources[:2], Sift()), collect_views(sources[2:4], Sift())
    assigned = {view.photograph: words for view in own + unseen}
    own_error, unseen_error = (data.measure_quantisation_error(views, assigned, public) for views in (own, unseen))
    assert own_error < 0.9 * unseen_error
    with pytest.raises(UserError, match="trust in words"):
        check_quantisation(own_error, unseen_error)
    check_quantisation(0.98 * unseen_error, unseen_error)


@pytest.mark.slow
def test_a_photograph_is_never_quantised_by_its_own_dictionary(sources, words, tmp_path):
    public = Public()
    inside, outside = sources[0].content_hash(), sources[3].content_hash()
    with pytest.raises(UserError, match="--crossfit"):
        data.assign_dictionaries({inside, outside}, [words], public)
    unrelated = Asset(tmp_path / "other.safetensors")
    dictionary.save(tmp_path / "other.safetensors", public.dictionary(words).words[:2000], {"photographs": []})
    assert data.assign_dictionaries({inside, outside}, [words, unrelated], public) == {inside: unrelated, outside: words}


@pytest.mark.slow
def test_dictionaries_must_have_equal_size(sources, words, tmp_path):
    """At the same ε, sets from a smaller dictionary contain the true word more often."""
    public, few = Public(), Asset(tmp_path / "few.safetensors")
    dictionary.save(tmp_path / "few.safetensors", public.dictionary(words).words[:2000], {"photographs": []})
    defense = LDP(epsilon=6.0, dictionary=words)
    assert dataclasses.replace(defense, dictionary=few).privacy(public).log10_true > defense.privacy(public).log10_true
    with pytest.raises(UserError, match="different sizes"):
        train(build_plan(sources, targets=[fix(defense)], crossfit=[few], training=TINY), tmp_path / "W.safetensors")
    data.check_dictionary_sizes({words, few}, [2000, 1000], public)  # both have that many words
    with pytest.raises(UserError, match="different sizes"):
        data.check_dictionary_sizes({words, few}, [1000, 0], public)


def test_the_quantisation_table_agrees_with_single_queries(sources, words):
    views = collect_views(sources[3:4], Sift())
    assigned = {view.photograph: words for view in views}
    sizes, plain = [0, 2000, 500], Public()
    table = data.quantise(views, assigned, sizes, Public())
    for view in views:
        for size in sizes:
            expected = plain.nearest_words(words, view.features, size)
            assert np.array_equal(table(plain.dictionary(words, size), view.features.codes), expected)
    with pytest.raises(KeyError):
        table(plain.dictionary(words), np.full((1, 128), 7, np.uint8))


def test_an_interrupted_quantisation_resumes_where_it_ended(sources, words, monkeypatch, tmp_path):
    monkeypatch.setenv("FEATURE_PRIVACY_CACHE", str(tmp_path))
    monkeypatch.setattr(data, "STORED_ROWS", 100)
    views, searched = collect_views(sources[3:4], Sift()), []
    arguments = views, {view.photograph: words for view in views}, [0, 500]
    find_nearest = WordIndex.find_nearest

    def search(index, queries, *more):
        searched.append(len(queries))
        if len(searched) == 3:
            raise KeyboardInterrupt
        return find_nearest(index, queries, *more)

    monkeypatch.setattr(WordIndex, "find_nearest", search)
    with pytest.raises(KeyboardInterrupt):
        data.quantise(*arguments, Public())
    resumed = data.quantise(*arguments, Public())
    before = len(searched)
    again = data.quantise(*arguments, Public())
    assert len(searched) == before  # every word is stored
    with monkeypatch.context() as empty:
        empty.setenv("FEATURE_PRIVACY_CACHE", str(tmp_path / "empty"))
        whole = data.quantise(*arguments, Public())
    assert len(searched) == 2 * before - 1  # the search that was interrupted is the only one that was repeated
    for table in (resumed, again):
        for digest, (keys, found) in whole.tables.items():
            assert np.array_equal(table.tables[digest][0], keys)
            assert np.array_equal(table.tables[digest][1], found)


def test_crops_contain_the_keypoints_inside_them(sources, rng):
    view = max(collect_views(sources[:1], Sift()), key=lambda view: len(view.pixels))
    index = {tuple(code): number for number, code in enumerate(view.features.codes)}
    for _ in range(10):
        pixels, features = data.draw_crop(view, rng)
        offsets = view.features.keypoints[[index[tuple(code)] for code in features.codes]] - features.keypoints
        left, top = np.rint(np.median(offsets, axis=0)).astype(int)
        assert np.array_equal(pixels, view.pixels[top : top + 256, left : left + 256])
        inside = ((view.features.keypoints >= (left, top)) & (view.features.keypoints < (left + 256, top + 256))).all(axis=1)
        assert np.array_equal(features.codes, view.features.codes[inside])


def test_a_network_is_incompatible_with_other_releases(sources, words, tmp_path):
    public, path = Public(), tmp_path / "W.safetensors"
    supported = {"epsilon": Between(8.0, 16.0), "subset_size": OneOf((1, 2))}
    shape = Shape(inputs=2 * 128 + 2 + 2)
    target = Target(defense=LDP(dictionary=words), supported_settings=supported)
    meta = {**weights.describe([target], Sift(), public), "encoding": "released", "slots": 2}
    weights.save(path, Inverter(shape), shape, meta)
    meta = weights.load(path).meta
    compatible = LDP(epsilon=9, subset_size=2, dictionary=words)
    assert weights.explain_incompatible(meta, compatible, Sift(), public) is None
    for other, extractor, reason in [
        (dataclasses.replace(compatible, epsilon=20), Sift(), "epsilon 8 to 16, not 20"),
        (dataclasses.replace(compatible, subset_size=3), Sift(), "subset_size 1, 2, not 3"),
        (Undefended(), Sift(), "trained for ldp"),
        (compatible, Sift(upright=False), "features with upright True, not False"),
    ]:
        assert reason in (weights.explain_incompatible(meta, other, extractor, public) or "")
    copied = tmp_path / "other.safetensors"
    dictionary.save(copied, public.dictionary(words).words[::-1], {"photographs": []})
    assert "dictionary sha256" in (weights.explain_incompatible(meta, LDP(dictionary=Asset(copied)), Sift(), public) or "")


@pytest.mark.slow
def test_one_network_for_several_numbers_of_keypoints(sources, tmp_path):
    plan = build_plan(sources, keypoints=(50, 200), training=TINY)
    counts = [len(view.features) for view in collect_views(list(plan.photographs), plan.training_extractor)]
    assert min(counts) >= 50
    assert max(counts) <= 200
    assert len(set(counts)) == len(counts) == 8  # each view has its own
    alone = collect_views(list(plan.photographs), Sift(max_keypoints=counts[0]))[0].features  # those of highest score
    first = collect_views(list(plan.photographs), plan.training_extractor)[0].features
    assert np.array_equal(alone.keypoints, first.keypoints)
    meta = train(plan, tmp_path / "W.safetensors")
    for extractor, reason in [
        (Sift(max_keypoints=50), None),
        (Sift(max_keypoints=200), None),
        (Sift(), "trained for features with max_keypoints from 50 to 200, not 1000"),
        (Sift(max_keypoints=100, upright=False), "trained for features with upright True, not False"),
    ]:
        assert weights.explain_incompatible(meta, Undefended(), extractor, Public()) == reason


@pytest.mark.parametrize(
    ("limits", "message"), [((5,), "expected LOW,HIGH"), ((9, 3), "1 ≤ LOW ≤ HIGH, got 9,3"), ((0, 3), "expected LOW,HIGH")]
)
def test_wrong_numbers_of_keypoints_are_refused(limits, message, sources):
    with pytest.raises(UserError, match=message):
        build_plan(sources, keypoints=limits)


def test_one_network_for_several_defenses(sources, words, tmp_path):
    """Words and descriptors, with settings of their own. Control: the network reads which defense it is."""
    plateau = {"epsilon": Between(8.0, 16.0), "subset_size": OneOf((1, 3))}
    targets = [
        Target(defense=Plateau(dictionary=words), supported_settings=plateau),
        Target(defense=PrivUnit(dictionary=words), supported_settings={"epsilon": Between(4.0, 32.0)}),
        fix(NaiveLDP()),
    ]
    out, public = tmp_path / "W.safetensors", Public()
    meta = train(build_plan(sources[3:], validation=sources[2:3], targets=targets, training=TINY), out)
    assert (meta["slots"], weights.list_defenses(meta)) == (3, ["naive-ldp", "plateau", "privunit"])
    network = weights.load(out)
    for defense, expected in (
        (Plateau(dictionary=words, epsilon=10, subset_size=3), [1, 0.25, 1, 0, 0, 0]),
        (PrivUnit(dictionary=words, epsilon=11), [0, 0, 0, 1, 0.25, 0]),
        (NaiveLDP(), [0, 0, 0, 0, 0, 1]),
    ):
        assert weights.explain_incompatible(network.meta, defense, Sift(), public) is None
        assert np.allclose(network.encode_settings(defense, public), expected)
    for defense, reason in (
        (Plateau(dictionary=words, epsilon=20), "epsilon 8"),
        (PrivUnit(dictionary=words, centred=False), "centred True"),
        (LDP(dictionary=words), "trained for naive-ldp, plateau, privunit"),
    ):
        assert reason in (weights.explain_incompatible(network.meta, defense, Sift(), public) or "")
    release = Plateau(dictionary=words, subset_size=1).protect(
        collect_views(sources[3:4], Sift())[0].features, public, np.random.default_rng(0)
    )
    one, other = (
        infer(network.module, encode([release], [np.array(condition, np.float32)], 3, "invariant"))
        for condition in ([1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0])
    )
    assert not torch.equal(one, other)


@pytest.mark.parametrize(
    ("defenses", "message"),
    [
        ([Affine(), Undefended()], "reads no other releases"),
        ([Plateau(), LDP(dictionary=Asset("other.safetensors"))], "needs one dictionary"),
    ],
)
def test_defenses_that_one_network_cannot_read_are_refused(sources, tmp_path, defenses, message):
    with pytest.raises(UserError, match=message):
        train(build_plan(sources, targets=[fix(defense) for defense in defenses]), tmp_path / "W.safetensors")


RAW_METADATA = {**weights.describe([fix(Undefended())], Sift(), Public()), "encoding": "invariant", "slots": 1}


def test_saved_weights_give_the_same_network(sources, tmp_path, rng):
    shape = Shape(inputs=130)
    net = Inverter(shape).eval()
    path = tmp_path / "W.safetensors"
    weights.save(path, net, shape, RAW_METADATA)
    points = encode([draw_releases(rng)[0]], [np.empty(0, np.float32)], slots=1, encoding="invariant")
    torch.testing.assert_close(infer(weights.load(path).module, points), infer(net, points), atol=0.02, rtol=0)
    assert torch.equal(infer(net, points), infer(net, points))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda arrays: {name: array.astype(np.int32) for name, array in arrays.items()}, "int32, expected float16"),
        (lambda arrays: {name: array[..., :1] for name, array in arrays.items()}, "has shape"),
        (lambda arrays: dict(list(arrays.items())[1:]), "nothing, expected"),
    ],
)
def test_weights_of_another_network_are_refused(spoil, message, tmp_path):
    from bench.formats import tensor_file

    shape, path = Shape(inputs=130), tmp_path / "W.safetensors"
    weights.save(path, Inverter(shape), shape, RAW_METADATA)
    arrays, meta, _ = tensor_file.load(path, weights.KIND)
    tensor_file.save(path, weights.KIND, spoil(arrays), meta)
    with pytest.raises(UserError, match=message):
        weights.load(path).verify()


def test_weights_outside_the_range_of_half_precision_are_stored_in_single_precision(tmp_path, rng):
    """In half precision, a variance of a batch norm above 65,504 would be infinite and its channel constant."""
    shape, path = Shape(inputs=130), tmp_path / "W.safetensors"
    network = Inverter(shape).eval()
    network.stem[1].running_var.fill_(1e5)
    network.stem[0].weight.data.mul_(1e5**0.5)  # large, and normalised to the same output
    points = encode([draw_releases(rng)[0]], [np.empty(0, np.float32)], 1, "invariant")
    expected = network(points)
    weights.save(path, network, shape, RAW_METADATA)
    torch.testing.assert_close(weights.load(path).module(points), expected, atol=2e-3, rtol=0)
    assert path.stat().st_size < 0.51 * sum(4 * value.numel() for value in network.state_dict().values())
    network.stem[1].running_var.fill_(np.inf)  # control: the half-precision value
    assert not torch.allclose(network(points), expected, atol=2e-3, rtol=0)
    weights.save(path, network, shape, RAW_METADATA)
    with pytest.raises(UserError, match=r"stem.1.running_var has non-finite numbers"):
        weights.load(path)


def test_weights_without_metadata_are_refused(tmp_path):
    shape, path = Shape(inputs=130), tmp_path / "W.safetensors"
    weights.save(path, Inverter(shape), shape, {name: value for name, value in RAW_METADATA.items() if name != "encoding"})
    with pytest.raises(UserError, match="metadata lack encoding"):
        weights.load(path)


@pytest.mark.slow
def test_bench_train_trains_resumes_and_continues(album, tmp_path, sources, capsys):
    held = tmp_path / "held"
    held.mkdir()
    (held / "coffee.png").write_bytes(sources[2].path.read_bytes())
    out = tmp_path / "W.safetensors"
    command = ["train", "--defense", "none", "--images", str(album), "--validation", str(held), "--out", str(out)]
    command[1:1] = ["--widths", "8,8"]
    assert main([*command, "--steps", "2", "--batch", "2"]) == 0
    assert "4 training samples from 2 photographs" in capsys.readouterr().out
    before = out.read_bytes()
    assert main([*command, "--steps", "2", "--batch", "2"]) == 0  # the network exists
    again = tmp_path / "again.safetensors"
    assert main([*command[:-1], str(again), "--steps", "2", "--batch", "2", "--initial-checkpoint", str(out)]) == 0
    assert weights.load(again).meta["start"] == weights.load(out).digest
    third = tmp_path / "third.safetensors"
    assert main([*command[:-1], str(third), "--steps", "1", "--batch", "2", "--initial-checkpoint", str(again)]) == 0
    stages = weights.list_training_stages(weights.load(third).meta)
    assert [stage["start"] for stage in stages] == [None, weights.load(out).digest, weights.load(again).digest]
    assert [stage["crops"] for stage in stages] == [4, 4, 2]
    assert main([*command, "--steps", "3", "--batch", "2"]) == 2
    assert "another training" in capsys.readouterr().err.splitlines()[-1]
    assert out.read_bytes() == before
    assert (
        main(["run", "--defense", "none", "--attack", f"dia:weights={out}", "--images", str(held), "--out", str(tmp_path / "r")])
        == 0
    )


@pytest.mark.parametrize(
    ("attack", "defense", "command"),
    [
        (DIA(), LDP(), "bench train --defense ldp"),
        (DIA(), LDP(epsilon=20), "bench train --defense ldp:epsilon=20"),
        (DIALines(), RandomLines(), "bench train --defense lines"),
        (Generative(), Undefended(), "bench train --model flow --defense none"),
    ],
)
def test_without_a_network_an_attack_does_not_apply(attack, defense, command, monkeypatch, tmp_path):
    """It says how to train one, and refuses to run. Control: with a file of another network, the reason names the file."""
    monkeypatch.setattr(weights, "ASSETS", tmp_path)
    reason = f"no adapted attacker; train one with `{command}` and pass {attack.name()}:weights=FILE"
    assert attack.explain_not_applicable(defense, Sift(), Public()) == reason
    with pytest.raises(UserError, match=re.escape(f"{attack.name()}: {reason}")):
        attack.assets(defense, Sift(), Public())
    other = dataclasses.replace(attack, weights=Asset(str(ASSETS / "inversion-affine.safetensors")))
    assert "no adapted attacker (inversion-affine.safetensors " in str(other.explain_not_applicable(defense, Sift(), Public()))
