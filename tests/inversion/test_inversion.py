"""The inversion network: encoding, loss, training that resumes exactly, weights, and the rule about quantised photographs."""

import dataclasses

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from bench.api import Asset, Between, OneOf
from bench.cli import main
from bench.codebook import build, dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.images.photographs import Source
from bench.images.views import OnDemand, collect
from bench.inversion import data, weights
from bench.inversion.encoding import Points, condition, encode, stack
from bench.inversion.loss import reconstruction_loss, ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Plan, Training
from bench.inversion.reconstruct import paint
from bench.inversion.train import check_quantisation, train
from bench.types import Descriptors, Subspaces, WordSets
from defenses.affine import Affine, reparameterise
from defenses.ldp import LDP
from defenses.none import Undefended

TINY = Training(steps=6, batch=2, warmup=2)


@pytest.fixture(scope="module")
def sources():
    return photographs.builtin()


@pytest.fixture(scope="module")
def album(sources, tmp_path_factory):
    """Two photographs to train on, in a folder."""
    folder = tmp_path_factory.mktemp("album")
    for source in sources[:2]:
        (folder / source.path.name).write_bytes(source.path.read_bytes())
    return folder


@pytest.fixture(scope="module")
def words(album, tmp_path_factory):
    """A dictionary made from the two photographs of the album."""
    path = tmp_path_factory.mktemp("k") / "K.safetensors"
    build.build(album, 3000, path, Sift(), seed=0)
    return Asset(path)


def example_releases(rng, count=5):
    where = {"keypoints": rng.uniform(0, 256, (count, 2)).astype(np.float32), "size": (256, 256)}
    unit = rng.normal(size=(count, 3, 128)).astype(np.float32)
    return [
        Descriptors(**where, descriptors=unit[:, 0]),
        WordSets(**where, candidates=unit, words=None),
        Subspaces(**where, origins=unit[:, 0], bases=unit[:, 1:]),
    ]


def test_every_kind_of_release_has_a_stacking(rng):
    assert [stack(release, "invariant").shape[1] for release in example_releases(rng)] == [1, 3, 17]
    with pytest.raises(TypeError, match="no stacking"):
        stack(object(), "invariant")


def test_subspaces_are_read_as_themselves_and_not_as_they_were_written(rng):
    """Two re-parameterisations of one D stack alike; two different D do not (negative control)."""
    d = rng.normal(size=(20, 128))
    span = np.linalg.qr(rng.normal(size=(20, 128, 6)))[0].transpose(0, 2, 1)
    where = {"keypoints": np.zeros((20, 2), np.float32), "size": (256, 256)}

    def stacked(point):
        origins, bases = reparameterise(point, span, rng)
        return stack(Subspaces(**where, origins=origins, bases=bases), "invariant")

    first = stacked(d)
    np.testing.assert_allclose(first, stacked(d), atol=1e-5)
    np.testing.assert_allclose(first, stacked(d + rng.normal(size=(20, 1)) * span[:, 0]), atol=1e-5)
    assert np.abs(first - stacked(rng.normal(size=(20, 128)))).max() > 0.1


def test_the_papers_stacking_changes_with_the_basis_that_was_drawn(rng):
    d, span = rng.normal(size=(20, 128)), np.linalg.qr(rng.normal(size=(20, 128, 6)))[0].transpose(0, 2, 1)
    where = {"keypoints": np.zeros((20, 2), np.float32), "size": (256, 256)}

    def stacked():
        origins, bases = reparameterise(d, span, rng)
        return stack(Subspaces(**where, origins=origins, bases=bases), "released")

    assert stacked().shape == (20, 1 + 6, 128)
    assert np.abs(stacked() - stacked()).max() > 0.1


def test_positions_alone_encode_no_descriptor(rng):
    first, second, third = (encode([release], [np.empty(0, np.float32)], 0, "positions") for release in example_releases(rng))
    assert first.values.shape == (5, 2)
    assert torch.equal(first.values, second.values)
    assert torch.equal(first.values, third.values)


def test_frames_are_encoded_where_they_are_sent(rng):
    release = example_releases(rng)[0]
    framed = dataclasses.replace(release, frames=np.array([[8.0, np.pi / 2]] * 5, np.float32))
    values = encode([framed], [np.ones(1, np.float32)], 1, "invariant").values
    np.testing.assert_allclose(values[:, 130:], [[1, 0, 1, 1]] * 5, atol=1e-6)  # an octave over 4 pixels, cosine, sine; condition
    scaled = dataclasses.replace(framed, frames=framed.frames[:, :1])
    assert encode([scaled], [np.ones(1, np.float32)], 1, "invariant").values.shape == (5, 128 + 2 + 1 + 1)


def test_a_set_network_ignores_order_and_padding(rng):
    release = example_releases(rng)[1]
    shuffled = dataclasses.replace(release, candidates=release.candidates[:, ::-1])
    told = [np.ones(1, np.float32)]

    def painted(network, of, slots):
        return network(encode([of], told, slots, "invariant"))

    torch.manual_seed(0)
    reads_sets = Inverter(Shape(inputs=4 * 128 + 3, candidates=4, length=128)).eval()
    torch.testing.assert_close(painted(reads_sets, release, 4), painted(reads_sets, shuffled, 4))
    fewer = Inverter(Shape(inputs=3 * 128 + 3, candidates=3, length=128)).eval()
    fewer.load_state_dict(reads_sets.state_dict())
    torch.testing.assert_close(painted(fewer, release, 3), painted(reads_sets, release, 4))
    reads_stacks = Inverter(Shape(inputs=4 * 128 + 3)).eval()  # negative control
    assert not torch.allclose(painted(reads_stacks, release, 4), painted(reads_stacks, shuffled, 4), atol=1e-4)


def test_encoding_pads_and_places(rng):
    release = example_releases(rng)[1]
    points = encode([release, release], [np.array([0.25], np.float32)] * 2, slots=4, encoding="invariant")
    assert points.values.shape == (10, 4 * 128 + 2 + 1)
    assert (points.values[:, 3 * 128 : 4 * 128] == 0).all()
    assert (points.values[:, -1] == 0.25).all()
    row, column = int(release.keypoints[0, 1] // 4), int(release.keypoints[0, 0] // 4)
    assert points.places[0].long().tolist() == [column, row]
    assert points.image.tolist() == [0] * 5 + [1] * 5
    assert points.grid == (64, 64)
    with pytest.raises(ValueError, match="at most 2"):
        encode([release], [np.empty(0, np.float32)], slots=2, encoding="invariant")


def test_keypoints_on_the_border_stay_in_the_grid():
    corners = np.array([[0, 0], [256, 256], [-1, 300]], np.float32)
    release = Descriptors(keypoints=corners, size=(256, 256), descriptors=np.zeros((3, 128), np.float32))
    points = encode([release], [np.empty(0, np.float32)], slots=1, encoding="invariant")
    assert points.places.long().tolist() == [[0, 0], [63, 63], [0, 63]]


def test_conditions_are_the_served_settings():
    served = {"epsilon": Between(8.0, 16.0), "subset_size": OneOf((1, 2, 3, 4))}
    assert np.allclose(condition(LDP(epsilon=10, subset_size=4), served), [0.25, 1.0])
    assert condition(Undefended(), {}).shape == (0,)


def scattered(net, values, places, size=(64, 48)):
    with torch.inference_mode():
        return net.scatter(Points(values, places, torch.zeros(len(values), dtype=torch.int64), 1, size))[0]  # (C, H/4, W/4)


@pytest.mark.parametrize("patch", [5, 6])
def test_keypoints_that_share_a_cell_are_added_up(patch, rng):
    """The rule of `network.py`, whatever the order of the keypoints; patches reach as far on all sides, and not outside."""
    net, counts = Inverter(Shape(inputs=130, widths=(9, 9), patch=patch, painted=2)).eval(), 8  # the channel that counts
    values = torch.from_numpy(rng.normal(size=(3, 130)).astype(np.float32))
    places = torch.tensor([[7.3, 1.8], [7.6, 1.2], [0.2, 15.7]])
    grid = scattered(net, values, places)
    expected = torch.zeros(16, 12, counts + 3)
    with torch.inference_mode():
        hidden = net.embed(values)
        own, around = net.own(hidden), net.around(hidden).view(3, patch, patch, 2)
    for keypoint, (x, y) in enumerate(places.tolist()):
        expected[int(y), int(x), :counts] += own[keypoint]
        expected[int(y), int(x), counts] += 1
        for row in range(patch):
            for column in range(patch):
                # The patch's middle is the keypoint, to half a cell.
                down, right = int(np.floor(y - (patch - 1) / 2)) + row, int(np.floor(x - (patch - 1) / 2)) + column
                if 0 <= down < 16 and 0 <= right < 12:
                    expected[down, right, counts + 1 :] += around[keypoint, row, column]
    torch.testing.assert_close(grid, expected.permute(2, 0, 1), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(scattered(net, values.flip(0), places.flip(0)), grid, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(scattered(net, values.flip(0), places), grid, atol=1e-2)  # control: it matters who lies where


@pytest.mark.parametrize("size", [(256, 256), (255, 130), (7, 1)])
def test_an_image_of_any_size_is_painted(size, rng):
    height, width = size
    release = Descriptors(
        keypoints=rng.uniform(0, (width, height), (5, 2)).astype(np.float32),
        size=(width, height),
        descriptors=rng.normal(size=(5, 128)).astype(np.float32),
    )
    points = encode([release], [np.empty(0, np.float32)], slots=1, encoding="invariant")
    assert paint(Inverter(Shape(inputs=130, widths=(8, 8, 8))).eval(), points).shape == (1, 3, height, width)


def test_ssim_of_the_loss_is_scikit_images(rng):
    a, b = rng.random((2, 64, 64)).astype(np.float32)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    full = structural_similarity(a, b, full=True, **settings)[1][5:-5, 5:-5].mean()
    ours = float(ssim(torch.from_numpy(a)[None], torch.from_numpy(b)[None]))
    assert ours == pytest.approx(full, abs=1e-5)
    other = structural_similarity(a, b, full=True, **settings | {"sigma": 1.0})[1][5:-5, 5:-5].mean()
    assert ours != pytest.approx(other, abs=1e-4)  # negative control: the comparison tells settings apart


def test_loss_of_the_truth_is_zero(rng):
    image = torch.from_numpy(rng.random((1, 3, 64, 64)).astype(np.float32))
    assert float(reconstruction_loss(image, image)) == pytest.approx(0, abs=1e-6)
    assert float(reconstruction_loss(1 - image, image)) > 0.1


def of_two(sources, **given):
    """A training on two photographs, validated on a third."""
    data = {"photographs": sources[:2], "validation": sources[2:3], "extractor": Sift()}
    return Plan(**{"defense": Undefended(), "served": {}} | data | given)


@pytest.mark.parametrize("defense", [Undefended(), Affine(lifting="random", dim=2)])
def test_a_resumed_training_is_the_same_training(defense, sources, tmp_path, monkeypatch):
    import bench.inversion.train as module

    monkeypatch.setattr(module, "CHECKPOINT_EVERY", 3)
    plan = of_two(sources, defense=defense, training=TINY)
    whole = train(plan, tmp_path / "whole.safetensors")
    # Interrupt the second one after its third step.
    advance, steps = module._Trainer._advance, []

    def interrupted(self, *given):
        if len(steps) == 4:
            raise KeyboardInterrupt
        steps.append(1)
        return advance(self, *given)

    monkeypatch.setattr(module._Trainer, "_advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(plan, tmp_path / "parts.safetensors")
    monkeypatch.setattr(module._Trainer, "_advance", advance)
    parts = train(plan, tmp_path / "parts.safetensors")
    a, b = weights.load(tmp_path / "whole.safetensors"), weights.load(tmp_path / "parts.safetensors")
    assert a.digest == b.digest
    assert whole["validation"] == parts["validation"]
    other = train(dataclasses.replace(plan, training=dataclasses.replace(TINY, seed=1)), tmp_path / "other.safetensors")
    assert other["validation"] != whole["validation"]  # negative control


@pytest.mark.parametrize("defense", [Undefended(), LDP(epsilon=8, subset_size=2, words=2000)])
def test_views_made_on_demand_train_the_same_network(defense, sources, tmp_path, monkeypatch):
    """What does not fit into memory is read again and again, and changes nothing."""
    import bench.inversion.train as module

    plan = of_two(sources, defense=defense, training=TINY, widths=(8, 8))
    kept = train(plan, tmp_path / "kept.safetensors")
    monkeypatch.setattr(module, "IN_MEMORY", 1)
    made = train(plan, tmp_path / "made.safetensors")
    assert made == kept
    assert weights.load(tmp_path / "kept.safetensors").digest == weights.load(tmp_path / "made.safetensors").digest


def test_views_on_demand_leave_out_what_cannot_be_read(sources, tmp_path, rng):
    spoilt = Source("spoilt", tmp_path / "spoilt.png")
    spoilt.path.write_bytes(b"no picture")
    lazy, eager = OnDemand([spoilt, sources[0]], Sift()), collect([spoilt, sources[0]], Sift())
    assert [len(lazy), len(lazy[::4]), len(list(lazy)), len(eager)] == [8, 2, 4, 4]
    for one, other in zip(lazy, eager, strict=True):
        assert one.photograph == other.photograph
        assert np.array_equal(one.pixels, other.pixels)
        assert np.array_equal(one.features.codes, other.features.codes)
    assert data.Examples(lazy, Undefended(), {}, {}, Public()).draw(rng).pixels.shape == (256, 256, 3)
    with pytest.raises(UserError, match="none of 100"):
        data.Examples(lazy[:4], Undefended(), {}, {}, Public()).draw(rng)


@pytest.mark.parametrize(("slots", "candidates"), [(1, 1), (3, 1), (4, 4)])
def test_a_network_started_from_another_reads_a_descriptor_as_it_does(slots, candidates, rng):
    """A release whose first slot holds the descriptor is painted as by the network for raw descriptors."""
    trained, fresh = Inverter(Shape(inputs=130)).eval(), Inverter(Shape(inputs=slots * 128 + 2 + 1)).eval()
    weights.start_from(fresh, trained, candidates)
    raw = example_releases(rng)[0]
    rows = np.zeros((len(raw), slots, 128), np.float32)
    rows[:, 0] = raw.descriptors * np.float32(candidates**0.5)
    padded = WordSets(keypoints=raw.keypoints, size=raw.size, candidates=rows, words=None)
    mine = fresh(encode([padded], [np.ones(1, np.float32)], slots, "invariant"))
    theirs = trained(encode([raw], [np.empty(0, np.float32)], 1, "invariant"))
    torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(
        Inverter(Shape(inputs=130)).eval()(encode([raw], [np.empty(0, np.float32)], 1, "invariant")), theirs, atol=1e-2
    )


@pytest.mark.parametrize(
    "shape", [Shape(inputs=2), Shape(inputs=3 * 128 + 3), Shape(inputs=4 * 128 + 3, candidates=4, length=128)], ids=str
)
def test_a_network_started_from_one_for_such_releases_is_that_one(shape):
    """It goes on where the other ended, with all slots and the condition."""
    trained, fresh = Inverter(shape), Inverter(shape)
    weights.start_from(fresh, trained, max(1, shape.candidates))
    assert all(torch.equal(value, fresh.state_dict()[name]) for name, value in trained.state_dict().items())
    stranger = Inverter(Shape(inputs=2 * 128 + 3))  # of fewer slots
    with pytest.raises(UserError, match="reads other releases"):
        weights.start_from(stranger, trained, 1)


def test_training_learns(sources, tmp_path):
    """Forty steps on two photographs bring the loss well below that of the first."""
    import bench.inversion.train as module

    losses = []

    class Watched(module._Trainer):
        def _advance(self, *given):
            losses.append(super()._advance(*given))
            return losses[-1]

    original, module._Trainer = module._Trainer, Watched
    try:
        train(of_two(sources, training=Training(steps=40, batch=2, warmup=5)), tmp_path / "W")
    finally:
        module._Trainer = original
    assert np.mean(losses[-5:]) < 0.75 * np.mean(losses[:5])


def test_a_checkpoint_of_another_training_is_refused(sources, tmp_path, monkeypatch):
    import bench.inversion.train as module

    plan, out = of_two(sources, training=TINY), tmp_path / "W.safetensors"
    monkeypatch.setattr(module.weights, "save", lambda *_: (_ for _ in ()).throw(OSError("the disk is full")))
    with pytest.raises(OSError, match="disk"):
        train(plan, out)
    with pytest.raises(UserError, match="another training"):
        train(dataclasses.replace(plan, training=dataclasses.replace(TINY, seed=1)), out)


def test_photographs_in_both_sets_are_refused(sources, tmp_path):
    with pytest.raises(UserError, match="in both"):
        train(dataclasses.replace(of_two(sources), validation=sources[1:2]), tmp_path / "W")


def test_own_photographs_quantise_to_nearly_themselves(sources, words):
    """Negative control of the rule: a network trained on its own dictionary's photographs fails the check."""
    public = Public()
    own, unseen = collect(sources[:2], Sift()), collect(sources[2:4], Sift())
    chosen = {view.photograph: words for view in own + unseen}
    known, unknown = (data.quantisation_error(views, chosen, public) for views in (own, unseen))
    assert known < 0.9 * unknown
    with pytest.raises(UserError, match="trust words"):
        check_quantisation(known, unknown)
    check_quantisation(0.98 * unknown, unknown)


def test_a_photograph_is_never_quantised_by_its_own_dictionary(sources, words, tmp_path):
    public = Public()
    inside, outside = sources[0].content_hash(), sources[3].content_hash()
    with pytest.raises(UserError, match="--crossfit"):
        data.fitting_dictionaries({inside, outside}, [words], public)
    stranger = Asset(tmp_path / "other.safetensors")
    dictionary.save(stranger_path := tmp_path / "other.safetensors", public.dictionary(words).words[:2000], {"photographs": []})
    assert stranger_path.is_file()
    assert data.fitting_dictionaries({inside, outside}, [words, stranger], public) == {inside: stranger, outside: words}


def test_one_epsilon_must_mean_one_chance_of_the_truth(sources, words, tmp_path):
    """Of fewer words the true one is told more often, at the same epsilon."""
    public, few = Public(), Asset(tmp_path / "few.safetensors")
    dictionary.save(tmp_path / "few.safetensors", public.dictionary(words).words[:2000], {"photographs": []})
    defense = LDP(epsilon=6.0, dictionary=words)
    assert dataclasses.replace(defense, dictionary=few).privacy(public).log10_true > defense.privacy(public).log10_true
    with pytest.raises(UserError, match="other sizes"):
        train(of_two(sources, defense=defense, crossfit=[few], training=TINY), tmp_path / "W.safetensors")
    data.check_lengths({words, few}, [2000, 1000], public)  # of the first words of each there are as many
    with pytest.raises(UserError, match="other sizes"):
        data.check_lengths({words, few}, [1000, 0], public)


def test_quantisation_once_is_quantisation_each_time(sources, words):
    views = collect(sources[3:4], Sift())
    chosen = {view.photograph: words for view in views}
    sizes, plain = [0, 2000, 500], Public()
    table = data.quantise(views, chosen, sizes, Public())
    for view in views:
        for size in sizes:
            expected = plain.nearest_words(words, view.features, size)
            assert np.array_equal(table(plain.dictionary(words, size), view.features.codes), expected)
    with pytest.raises(KeyError):
        table(plain.dictionary(words), np.full((1, 128), 7, np.uint8))


def test_crops_keep_what_lies_within(sources, rng):
    view = max(collect(sources[:1], Sift()), key=lambda view: len(view.pixels))
    place = {tuple(code): number for number, code in enumerate(view.features.codes)}
    for _ in range(10):
        pixels, features = data.random_crop(view, rng)
        offsets = view.features.keypoints[[place[tuple(code)] for code in features.codes]] - features.keypoints
        left, top = np.rint(np.median(offsets, axis=0)).astype(int)
        assert np.array_equal(pixels, view.pixels[top : top + 256, left : left + 256])
        inside = ((view.features.keypoints >= (left, top)) & (view.features.keypoints < (left + 256, top + 256))).all(axis=1)
        assert np.array_equal(features.codes, view.features.codes[inside])


def test_a_network_knows_what_it_was_trained_for(sources, words, tmp_path):
    public, path = Public(), tmp_path / "W.safetensors"
    served = {"epsilon": Between(8.0, 16.0), "subset_size": OneOf((1, 2))}
    shape = Shape(inputs=2 * 128 + 2 + 2)
    meta = {**weights.describe(LDP(dictionary=words), served, Sift(), public), "encoding": "released", "slots": 2}
    weights.save(path, Inverter(shape), shape, meta)
    found = weights.load(path).meta
    fits = LDP(epsilon=9, subset_size=2, dictionary=words)
    assert weights.misfit(found, fits, Sift(), public) is None
    for other, extractor, reason in [
        (dataclasses.replace(fits, epsilon=20), Sift(), "epsilon 8 to 16, not 20"),
        (dataclasses.replace(fits, subset_size=3), Sift(), "subset_size 1, 2, not 3"),
        (Undefended(), Sift(), "trained for ldp"),
        (fits, Sift(upright=False), "features with upright True, not False"),
    ]:
        assert reason in (weights.misfit(found, other, extractor, public) or "")
    copied = tmp_path / "other.safetensors"
    dictionary.save(copied, public.dictionary(words).words[::-1], {"photographs": []})
    assert "dictionary sha256" in (weights.misfit(found, LDP(dictionary=Asset(copied)), Sift(), public) or "")


OF_RAW = {**weights.describe(Undefended(), {}, Sift(), Public()), "encoding": "invariant", "slots": 1}


def test_weights_keep_the_network(sources, tmp_path, rng):
    shape = Shape(inputs=130)
    net = Inverter(shape).eval()
    path = tmp_path / "W.safetensors"
    weights.save(path, net, shape, OF_RAW)
    points = encode([example_releases(rng)[0]], [np.empty(0, np.float32)], slots=1, encoding="invariant")
    torch.testing.assert_close(paint(weights.load(path).module, points), paint(net, points), atol=0.02, rtol=0)
    assert torch.equal(paint(net, points), paint(net, points))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda arrays: {name: array.astype(np.int32) for name, array in arrays.items()}, "int32, expected float16"),
        (lambda arrays: {name: array[..., :1] for name, array in arrays.items()}, "has shape"),
        (lambda arrays: dict(list(arrays.items())[1:]), "nothing, expected"),
    ],
)
def test_weights_that_do_not_fit(spoil, message, tmp_path):
    from bench.formats import tensor_file

    shape, path = Shape(inputs=130), tmp_path / "W.safetensors"
    weights.save(path, Inverter(shape), shape, OF_RAW)
    arrays, meta, _ = tensor_file.load(path, weights.KIND)
    tensor_file.save(path, weights.KIND, spoil(arrays), meta)
    with pytest.raises(UserError, match=message):
        weights.load(path)


def test_what_half_precision_cannot_hold_is_kept_whole(tmp_path, rng):
    """A batch norm's variance above 65,504 would be infinite, and its channel silent."""
    shape, path = Shape(inputs=130), tmp_path / "W.safetensors"
    network = Inverter(shape).eval()
    network.stem[1].running_var.fill_(1e5)
    network.stem[0].weight.data.mul_(1e5**0.5)  # as training makes it: large, and normed to what it was
    points = encode([example_releases(rng)[0]], [np.empty(0, np.float32)], 1, "invariant")
    painted = network(points)
    weights.save(path, network, shape, OF_RAW)
    torch.testing.assert_close(weights.load(path).module(points), painted, atol=2e-3, rtol=0)
    assert path.stat().st_size < 0.51 * sum(4 * value.numel() for value in network.state_dict().values())
    network.stem[1].running_var.fill_(np.inf)  # the control: what would have been kept
    assert not torch.allclose(network(points), painted, atol=2e-3, rtol=0)
    weights.save(path, network, shape, OF_RAW)
    with pytest.raises(UserError, match=r"stem.1.running_var has numbers that are not finite"):
        weights.load(path)


def test_weights_that_say_too_little(tmp_path):
    shape, path = Shape(inputs=130), tmp_path / "W.safetensors"
    weights.save(path, Inverter(shape), shape, {name: told for name, told in OF_RAW.items() if name != "encoding"})
    with pytest.raises(UserError, match="do not say encoding"):
        weights.load(path)


def test_from_the_command_line(album, tmp_path, sources, capsys):
    held = tmp_path / "held"
    held.mkdir()
    (held / "coffee.png").write_bytes(sources[2].path.read_bytes())
    out = tmp_path / "W.safetensors"
    command = ["train", "--defense", "none", "--images", str(album), "--validation", str(held), "--out", str(out)]
    assert main([*command, "--steps", "2", "--batch", "2"]) == 0
    assert "4 crops of 2 photographs" in capsys.readouterr().out
    before = out.read_bytes()
    assert main([*command, "--steps", "2", "--batch", "2"]) == 0  # done is done
    again = tmp_path / "again.safetensors"
    assert main([*command[:-1], str(again), "--steps", "2", "--batch", "2", "--start", str(out)]) == 0
    assert weights.load(again).meta["start"] == weights.load(out).digest
    third = tmp_path / "third.safetensors"
    assert main([*command[:-1], str(third), "--steps", "1", "--batch", "2", "--start", str(again)]) == 0
    told = weights.legs(weights.load(third).meta)
    assert [leg["start"] for leg in told] == [None, weights.load(out).digest, weights.load(again).digest]
    assert [leg["crops"] for leg in told] == [4, 4, 2]
    assert main([*command, "--steps", "3", "--batch", "2"]) == 2
    assert "another training" in capsys.readouterr().err.splitlines()[-1]
    assert out.read_bytes() == before
    assert (
        main(["run", "--defense", "none", "--attack", f"dia:weights={out}", "--images", str(held), "--out", str(tmp_path / "r")])
        == 0
    )
