"""Training data of the attackers of word sets against the code that attacks, and the resumption of their training."""

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import train_word_attackers as trainer
import word_training_data as data
from PIL import Image
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn

from attacks import dia
from bench.api import View
from bench.codebook import build, dictionary
from bench.codebook.public import ASSETS, Public
from bench.context import encoding, reconstruct
from bench.context import weights as context_weights
from bench.context.network import ContextModel, KeypointGraph, Shape
from bench.context.reconstruct import encode_posteriors
from bench.context.train import compute_loss, compute_pair_loss
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.identification.thumbnails import compute_thumbnail, normalize_thumbnails
from bench.images.photographs import Source, list_photographs
from bench.images.views import PhotographView
from bench.inversion import network, weights
from bench.inversion.data import assign_dictionaries
from bench.inversion.train import check_quantisation
from bench.settings import Asset
from bench.threat_model import PublicAssets
from bench.types import Points, WordSets
from defenses.ldp import LDP

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
WORDS = 2048
CORNERS = np.array([[9, 3], [0, 16], [16, 5]])
EPSILONS = np.array([5.0, 7.0, math.inf])
NEIGHBOURS = 6


@dataclasses.dataclass(frozen=True)
class World:
    """Six photographs in three thirds, and three dictionaries, each built from two of the thirds."""

    sources: list[Source]
    views: list[PhotographView]
    thirds: dict[str, str]  # photograph -> digit of its third
    dictionaries: dict[str, Asset]  # digits of the thirds -> dictionary
    unseen: list[PhotographView]
    unrelated: dict[str, Asset]  # photograph -> the dictionary that was not built from it

    def stack(self, assigned: dict[str, Asset]) -> data.TrainingData:
        return data.TrainingData(data.stack_views(self.views, CPU), data.find_words(self.views, assigned, Public(), CPU))


def write_texture(path: Path, seed: int) -> None:
    """Write smooth noise. All textures have equal statistics, so quantisation errors differ by the dictionary alone."""
    noise = np.random.default_rng(seed).normal(size=(320, 320, 3))
    smooth = gaussian_filter(noise, (2, 2, 0))
    path.parent.mkdir(exist_ok=True)
    Image.fromarray(np.clip(128 + 60 * smooth / smooth.std(), 0, 255).astype(np.uint8)).save(path)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("world")
    for number in range(6):
        for digits in ("12", "02", "01", "012"):
            if str(number % 3) in digits:
                write_texture(folder / digits / f"{number}.png", number)
    write_texture(folder / "unseen" / "6.png", 6)
    dictionaries = {}
    for digits in ("12", "02", "01"):
        dictionaries[digits] = Asset(folder / f"{digits}.safetensors")
        build.build(folder / digits, WORDS, Path(dictionaries[digits]), Sift(), 0)
    sources = list_photographs(folder / "012")
    views = data.collect_training_views(sources, (256, 272))
    thirds = {source.content_hash(): str(int(source.path.stem) % 3) for source in sources}
    unrelated = assign_dictionaries(set(thirds), list(dictionaries.values()), Public())
    unseen = data.collect_training_views([Source("6", folder / "unseen" / "6.png")], (256,))
    return World(sources, views, thirds, dictionaries, unseen, unrelated)


@pytest.fixture(scope="module")
def stacked(world: World) -> data.TrainingData:
    return world.stack(world.unrelated)


def assemble(stacked: data.TrainingData, symmetry: int, size: int = 2) -> data.Batch:
    """Return the crops at CORNERS of the first three views of 272 pixels, all under one symmetry."""
    crops = data.Crops(np.array([1, 3, 5]), CORNERS, np.full(3, symmetry))
    return data.assemble(stacked.views, stacked.words[0], crops, EPSILONS, size, NEIGHBOURS, np.random.default_rng(0))


def read_release(batch: data.Batch, number: int) -> WordSets:
    chosen = (batch.image == number).numpy()
    candidates = batch.example.graph.candidates.numpy()[chosen]
    return WordSets(
        positions=Points(keypoints=batch.keypoints.numpy()[chosen]), size=(256, 256), candidates=candidates, words=None
    )


# ---- batches


def test_a_batch_holds_the_crops_and_the_true_words(world: World, stacked: data.TrainingData) -> None:
    batch = assemble(stacked, 0)
    for number, (left, top) in enumerate(CORNERS):
        view = world.views[1 + 2 * number]
        pixels = view.pixels[top : top + 256, left : left + 256]
        assert np.array_equal((batch.photographs[number] * 255).round().permute(1, 2, 0).numpy().astype(np.uint8), pixels)
        shifted = view.features.keypoints - np.array([left, top], np.float32)
        inside = ((shifted >= 0) & (shifted < 256)).all(axis=1)
        chosen = batch.image == number
        assert np.array_equal(batch.keypoints[chosen].numpy(), shifted[inside])
        assert 0 < inside.sum() < len(inside)
        np.testing.assert_allclose(batch.example.descriptors[chosen].numpy(), view.features.descriptors[inside], atol=1e-6)
        asset, public = world.unrelated[view.photograph], Public()
        true = unit_rows(public.dictionary(asset).words)[public.nearest_words(asset, view.features.take(inside))]
        labels, candidates = batch.example.labels[chosen].numpy(), batch.example.graph.candidates[chosen].numpy()
        hit = labels < 2
        np.testing.assert_allclose(candidates[hit, labels[hit]], true[hit], atol=1e-6)
        chance = 2 * math.exp(min(EPSILONS[number], 50)) / (2 * math.exp(min(EPSILONS[number], 50)) + WORDS - 2)
        assert hit.mean() == pytest.approx(chance, abs=4 * math.sqrt(chance * (1 - chance) / len(hit)) + 1e-9)


@pytest.mark.parametrize("symmetry", range(8))
def test_a_batch_under_a_symmetry_is_the_transformed_batch(stacked: data.TrainingData, symmetry: int) -> None:
    """Against the code that attacks. Control: another symmetry gives another batch."""
    plain, found = assemble(stacked, 0), assemble(stacked, symmetry)
    other = assemble(stacked, (symmetry + 1) % 8)
    chosen = data.SYMMETRIES[symmetry]
    for number in range(3):
        expected, release = chosen.transform_release(read_release(plain, number)), read_release(found, number)
        assert np.array_equal(release.keypoints, expected.keypoints)
        assert np.array_equal(release.candidates, expected.candidates)
        assert not np.array_equal(read_release(other, number).keypoints, expected.keypoints)
        assert not np.array_equal(read_release(other, number).candidates, expected.candidates)
        pixels, before = ((part.photographs[number] * 255).round().permute(1, 2, 0).byte().numpy() for part in (found, plain))
        assert np.array_equal(pixels, chosen.transform_image(before))
        assert torch.equal(chosen.invert_image(found.photographs[number]), plain.photographs[number])


@pytest.mark.parametrize("size", [1, 3])
def test_graph_and_encoding_are_those_of_the_attack(stacked: data.TrainingData, size: int) -> None:
    batch = assemble(stacked, 3, size)
    releases = [read_release(batch, number) for number in range(3)]
    found = batch.example.graph
    odds = [float(found.odds[batch.image == number][0]) for number in range(3)]
    assert odds[2] == encoding.MAX_LOG_ODDS
    expected = encoding.build_graph(releases, odds, NEIGHBOURS)
    # Keypoints at equal distances are listed in any order, so edges are compared as sets.
    assert sort_edges(found) == sort_edges(expected)
    for name in ("candidates", "odds", "positions", "spacing", "present"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), msg=name)
    logs = torch.randn(len(found.odds), size + 1, generator=torch.Generator().manual_seed(0)).log_softmax(dim=1)
    encoded = data.encode_batch(batch, logs)
    for number, release in enumerate(releases):
        chosen = encoded.image == number
        alone = encode_posteriors(release, logs[chosen], odds[number])
        torch.testing.assert_close(encoded.values[chosen], alone.values)
        torch.testing.assert_close(encoded.coordinates[chosen], alone.coordinates)
    assert (encoded.batch, encoded.size) == (3, alone.size)


def sort_edges(graph: KeypointGraph) -> list[list[tuple[tuple[float, ...], bool]]]:
    """Return the displacement of each edge, and whether there is an edge back, checked to lead back."""
    count, k = graph.neighbours.shape
    mutual = graph.reverse < count * k
    rows = torch.arange(count)[:, None].expand(-1, k)
    assert torch.equal(graph.neighbours.flatten()[graph.reverse[mutual]], rows[mutual])
    assert 0.5 < mutual.float().mean() < 1
    return [
        sorted((tuple(offset), bool(back)) for offset, back in zip(offsets, backs, strict=True))
        for offsets, backs in zip(graph.offsets.tolist(), mutual.tolist(), strict=True)
    ]


# ---- dictionaries


def test_no_photograph_is_quantised_by_a_dictionary_built_from_it(world: World, stacked: data.TrainingData) -> None:
    """Control: with a dictionary of the photograph's own third, the check of the quantisation error fails."""
    names = {asset: digits for digits, asset in world.dictionaries.items()}
    assert all(world.thirds[photograph] not in names[asset] for photograph, asset in world.unrelated.items())
    own = {photograph: world.dictionaries["01" if third == "0" else "12"] for photograph, third in world.thirds.items()}
    validation = data.measure_errors(
        data.stack_views(world.unseen, CPU),
        data.find_words(world.unseen, {world.unseen[0].photograph: world.dictionaries["01"]}, Public(), CPU)[0],
    )[0]
    errors = data.measure_errors(stacked.views, stacked.words[0])
    assert len(errors) == 3
    for error in errors:
        check_quantisation(error, validation)
    leaking = world.stack(own)
    for error in data.measure_errors(leaking.views, leaking.words[0]):
        with pytest.raises(UserError, match="quantisation error"):
            check_quantisation(error, validation)


def test_training_data_are_stored_and_a_leaking_dictionary_is_refused(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control: the names of two dictionaries' photographs are exchanged, so that each is assigned to its own photographs."""
    monkeypatch.setattr(trainer, "LDP", functools.partial(LDP, dictionary=world.dictionaries["01"]))
    crossfit = [world.dictionaries["12"], world.dictionaries["02"]]
    path = tmp_path / "data.pt"
    built, meta = trainer.load_data(path, world.sources, world.unseen, crossfit, CPU)
    monkeypatch.setattr(trainer, "collect_training_views", None)  # not called again
    loaded, same = trainer.load_data(path, world.sources, world.unseen, crossfit, CPU)
    assert meta == same
    assert meta["photographs"] == sorted(world.thirds)
    assert len(loaded.views.pixels) == 4 * len(world.sources)
    for one, other in zip(built.words, loaded.words, strict=True):
        assert torch.equal(one.nearest, other.nearest)
        assert torch.equal(one.table, other.table)
    monkeypatch.setattr(trainer, "collect_training_views", lambda sources: world.views)
    lying = []
    for digits, other in (("12", "02"), ("02", "12")):
        words, claimed = dictionary.load(Path(world.dictionaries[digits])).words, dictionary.load(Path(world.dictionaries[other]))
        lying.append(Asset(tmp_path / f"{digits}.safetensors"))
        dictionary.save(Path(lying[-1]), words, claimed.meta)
    with pytest.raises(UserError, match="quantisation error"):
        trainer.load_data(tmp_path / "other.pt", world.sources, world.unseen, lying, CPU)


def test_smaller_dictionaries_are_the_first_half_and_clustered_words(world: World, stacked: data.TrainingData) -> None:
    whole, half, clustered = stacked.words
    assert (whole.size, half.size, clustered.size) == (WORDS, WORDS // 2, WORDS // 32)
    public, view, rows = Public(), world.views[3], slice(int(stacked.views.starts[3]), int(stacked.views.starts[4]))
    asset = world.unrelated[view.photograph]
    for words, size in ((whole, 0), (half, WORDS // 2)):
        expected = public.dictionary(asset).words[public.nearest_words(asset, view.features, size)]
        assert np.array_equal(words.table[words.nearest[rows]].numpy(), expected)
    nearest = clustered.nearest[rows] - clustered.first[3]
    assert nearest.min() >= 0
    assert nearest.max() < clustered.size


# ---- training


def build_stage(stacked: data.TrainingData, steps: int, stop: int | None = None) -> trainer.Stage:
    """Return a stage of tiny batches that is interrupted before step `stop`."""
    calls = iter(range(steps))

    def loss(module: ContextModel, rng: np.random.Generator) -> Tensor:
        if next(calls) == stop:
            raise KeyboardInterrupt
        releases = trainer.draw_releases(stacked, lambda size: 1, 4, rng)
        pairs = trainer.draw_pairs(stacked, 1, 4, rng)
        return compute_loss(module, releases.example) + compute_pair_loss(module, pairs.example, anchors=20)

    return trainer.Stage(name="tiny", number=1, steps=steps, rate=3e-3, average=0.9, loss=loss)


def build_model() -> ContextModel:
    torch.manual_seed(0)
    return ContextModel(Shape(width=8, hidden=8, rank=4, neighbours=4, layers=1, kernels=2))


def test_a_resumed_training_gives_the_weights_of_an_uninterrupted_one(stacked: data.TrainingData, tmp_path: Path) -> None:
    """Controls: the interrupted network is another, and so is one without the moments of the optimizer."""

    def train(name: str, change: Callable[[Path], None] = lambda path: None) -> ContextModel:
        model, path = build_model(), tmp_path / name
        with pytest.raises(KeyboardInterrupt):
            trainer.fit(model, build_stage(stacked, 6, stop=3), path, "", interval=0)
        change(path)
        resumed = build_model()
        trainer.fit(resumed, build_stage(stacked, 6), path, "", interval=0)
        assert not same_weights(resumed, model)
        return resumed

    def forget_moments(path: Path) -> None:
        arrays, meta, _ = trainer.tensor_file.load(path, trainer.CHECKPOINT)
        changed = {name: array * (0 if name.endswith("momentum_buffer") else 1) for name, array in arrays.items()}
        trainer.tensor_file.save(path, trainer.CHECKPOINT, changed, meta)

    whole = build_model()
    trainer.fit(whole, build_stage(stacked, 6), tmp_path / "whole", "")
    assert same_weights(train("parts"), whole)
    assert not same_weights(train("changed", forget_moments), whole)
    again = build_model()
    trainer.fit(again, build_stage(stacked, 6, stop=0), tmp_path / "whole", "")  # finished: no step is taken
    assert same_weights(again, whole)
    with pytest.raises(UserError, match="another training"):
        trainer.fit(build_model(), build_stage(stacked, 6), tmp_path / "whole", "other data")


def same_weights(one: nn.Module, other: nn.Module) -> bool:
    values = other.state_dict()
    return all(torch.equal(value, values[name]) for name, value in one.state_dict().items())


@pytest.mark.exhaustive
def test_both_networks_are_trained_and_the_attack_loads_them(
    world: World, stacked: data.TrainingData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few steps of tiny batches, then `dia` with the two files in place of the shipped ones."""
    monkeypatch.setattr(trainer, "CONTEXT_SHAPE", Shape(width=8, hidden=8, rank=4, neighbours=4, layers=1, kernels=2))
    monkeypatch.setattr(trainer, "PAIR_BATCH", 4)
    monkeypatch.setattr(trainer, "BATCH", 2)
    monkeypatch.setattr(trainer, "VALIDATED", trainer.VALIDATED[:1])
    monkeypatch.setattr(trainer, "RECONSTRUCTED", trainer.RECONSTRUCTED[:1])
    meta = {"photographs": sorted(world.thirds), "quantisation_error": {"training": 0.5, "validation": 0.5}}
    initial = weights.load(ASSETS / "inversion-none.safetensors")
    context = trainer.train_context(tmp_path / "context.safetensors", stacked, world.unseen, meta, 2, 2)
    path = trainer.train_inverter(tmp_path / "inversion-ldp.safetensors", stacked, world.unseen, meta, 1, context, initial)
    found, shipped = weights.load(path).meta, weights.load(ASSETS / path.name).meta
    assert found.keys() - {"validation"} == shipped.keys()
    different = {"batch", "crops", "context", "photographs", "quantisation_error", "shape"}
    assert {key: found[key] for key in shipped.keys() - different} == {key: shipped[key] for key in shipped.keys() - different}
    assert found["shape"] == dataclasses.asdict(network.Shape(**shipped["shape"]))  # a later field has its default
    assert context.meta.keys() == context_weights.load(ASSETS / "context.safetensors").meta.keys()
    for module in (reconstruct, weights):
        monkeypatch.setattr(module, "ASSETS", tmp_path)
    public = Public()
    assert dia.DIA().explain_not_applicable(LDP(), Sift(), public) is None
    release = LDP().protect(world.unseen[0].features, public, np.random.default_rng(0))
    knowledge = {PublicAssets: lambda: PublicAssets(assets=public)}
    view = View(release=release, defense=LDP(), extractor=Sift(), knowledge=knowledge)
    assert dia.DIA().reconstruct(view, np.random.default_rng(0)).shape == (256, 256, 3)


def test_the_schedule_rises_stays_and_falls_to_zero() -> None:
    rates = [trainer.compute_schedule(step, 1000) for step in range(1000)]
    assert rates[0] == 1 / trainer.WARMUP
    assert set(rates[200:601]) == {1.0}
    assert rates[800] == pytest.approx(0.5)
    assert 0 < rates[-1] < 0.003


def test_the_inversion_network_starts_from_that_for_raw_descriptors() -> None:
    """With one candidate of posterior 1, both embed alike."""
    initial = weights.load(ASSETS / "inversion-none.safetensors").module.cpu()
    module = trainer.build_inverter(initial)
    assert module.shape == weights.load(ASSETS / "inversion-ldp.safetensors").module.shape
    values = torch.randn(9, 130, generator=torch.Generator().manual_seed(0))
    defense = torch.tensor([[0.0, -30.0, 5.0, 0.25]]).expand(9, -1)
    found = module.embed_with_posteriors(torch.cat([values, defense], dim=1))
    torch.testing.assert_close(found, initial.embed(values))


def test_thumbnails_are_those_of_the_metric(world: World) -> None:
    """Except near the border, which the metric reflects."""
    images = torch.stack([torch.from_numpy(view.pixels).permute(2, 0, 1) for view in world.views[::2]]).float() / 255
    found = trainer.compute_thumbnails(images).numpy()
    expected = [normalize_thumbnails(compute_thumbnail(view.pixels / np.float32(255))) for view in world.views[::2]]
    assert ((found * np.stack(expected)).sum(axis=1) > 0.98).all()
    loss = trainer.compute_reconstruction_loss(images, images)
    assert loss < trainer.compute_reconstruction_loss(images.roll(1, 0), images) - 0.5
