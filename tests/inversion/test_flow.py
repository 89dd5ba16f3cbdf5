"""Flow matching: the path and its solver, the network, its training, and the attack `generative`."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import interrupted_training
from torch import Tensor

import bench
from attacks.dia import DIA
from attacks.generative import UNUSED, Generative
from bench.api import View
from bench.cli import main
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.context.drafts import Drafter
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.inversion import flow, weights
from bench.inversion.data import Target
from bench.inversion.encoding import EncodedRelease, NoisyRelease, encode
from bench.inversion.flow import FlowNetwork, add_noise, sample_images, solve, transform_cells, warp_time
from bench.inversion.learner import Learner
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Plan, Training
from bench.inversion.train import find_drafts, train
from bench.settings import Asset, Between, OneOf
from bench.testing import check_attack
from bench.threat_model import PublicAssets
from bench.types import Descriptors, Features, Points
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.none import Undefended

NONE = np.empty(0, np.float32)
TINY = Training(steps=4, batch=2, warmup=2)

pytestmark = pytest.mark.usefixtures("narrow_networks")


def build_network(seed: int = 0, length: int = 128) -> FlowNetwork:
    """Return a network whose weights are all random, in inference."""
    torch.manual_seed(seed)
    network = FlowNetwork(Shape(inputs=length + 2, length=length, widths=(8, 8)))
    for weight in (*network.head.parameters(), *network.shifts.parameters()):
        torch.nn.init.normal_(weight, std=0.1)
    return network.eval()


def encode_secret(secret: Features) -> EncodedRelease:
    positions = Points(keypoints=secret.keypoints)
    release = Descriptors(positions=positions, size=secret.size, descriptors=secret.descriptors)
    return encode([release], [NONE], 1, "invariant")


def draw_photographs(points: EncodedRelease, seed: int = 0) -> Tensor:
    return torch.rand(points.batch, 3, *points.size, generator=torch.Generator().manual_seed(seed))


# ---- the path and the solver


MEAN, SPREAD = 0.3, 0.2


def gaussian_velocity(x: Tensor, time: float) -> Tensor:
    """The exact velocity if photographs are N(MEAN, SPREAD²): the conditional mean of photograph - noise given x_t."""
    variance = (1 - time) ** 2 + (time * SPREAD) ** 2
    return MEAN + (time * SPREAD**2 - (1 - time)) / variance * (x - time * MEAN)


def test_the_exact_velocity_transports_noise_to_gaussian_photographs() -> None:
    """Its solution is MEAN + SPREAD noise. Control: half the velocity ends elsewhere."""
    noise = torch.linspace(-2, 2, 9, dtype=torch.float64)
    times = [warp_time(step / 1000) for step in range(1001)]
    torch.testing.assert_close(solve(gaussian_velocity, noise, times), MEAN + SPREAD * noise, atol=1e-4, rtol=0)
    other = solve(lambda x, time: gaussian_velocity(x, time) / 2, noise, times)
    assert (other - MEAN - SPREAD * noise).abs().max() > 0.1


def test_the_solver_has_order_two() -> None:
    """Twice the steps give a quarter of the error. Control: Euler's method has order one."""

    def euler(steps: int) -> Tensor:
        x = torch.ones(1, dtype=torch.float64)
        for step in range(steps):
            x = x + gaussian_velocity(x, step / steps) / steps
        return x

    def heun(steps: int) -> Tensor:
        return solve(gaussian_velocity, torch.ones(1, dtype=torch.float64), [step / steps for step in range(steps + 1)])

    for method, order in ((heun, 2), (euler, 1)):
        errors = [abs(float(method(steps)) - MEAN - SPREAD) for steps in (400, 800)]
        assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


def test_the_mean_velocity_of_training_is_the_exact_velocity(rng: np.random.Generator) -> None:
    """Regression of the target on x_t gives the velocity that transports noise to data, for each t."""
    photograph, noise = rng.normal(MEAN, SPREAD, 200_000), rng.normal(size=200_000)
    for time in (0.0, 0.25, 0.5, 1.0):
        noisy = (1 - time) * noise + time * photograph
        slope, intercept = np.polyfit(noisy, photograph - noise, 1)
        expected = gaussian_velocity(torch.tensor([0.0, 1.0], dtype=torch.float64), time)
        assert intercept == pytest.approx(float(expected[0]), abs=0.02)
        assert slope == pytest.approx(float(expected[1] - expected[0]), abs=0.02)


def test_an_untrained_network_samples_independent_gaussians_around_the_draft() -> None:
    """The end of the path is draft + s noise. Without a draft, or without the release, it is the noise itself."""
    network = FlowNetwork(Shape(inputs=130, length=128, widths=(8, 8))).eval()
    network.floor.fill_(0.09)
    network.slope.fill_(2.0)
    points = encode_secret(draw_features(5))
    draft = draw_photographs(points)
    draft[..., : draft.shape[-1] // 2] = 0.5  # without energy
    variance = 0.09 + 2 * flow.measure_energy(network.to_cells(draft))
    assert variance.min() == pytest.approx(0.09)
    assert variance.max() > 0.2
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(1, 48, *points.grid, generator=generator)
    times = [warp_time(step / 60) for step in range(61)]
    drafted = dataclasses.replace(points, drafts=draft)
    with torch.inference_mode():
        for given, guidance, expected in (
            (points, 1.0, noise),
            (drafted, 1.0, network.to_cells(draft) + variance.sqrt() * noise),
            (drafted, 0.0, noise),
        ):
            end = solve(flow.guide(network, network.build_condition(given), guidance), noise, times)
            torch.testing.assert_close(end, expected, atol=2e-2, rtol=0)


def test_the_measured_variance_grows_with_the_energy_of_the_draft() -> None:
    network = FlowNetwork(Shape(inputs=130, length=128, widths=(8, 8)))
    generator = torch.Generator().manual_seed(0)
    strength = torch.rand(4, 1, 6, 6, generator=generator).repeat_interleave(12, 2).repeat_interleave(12, 3)
    drafts = torch.randn(4, 48, 72, 72, generator=generator) * strength
    variance = 0.2 + 0.5 * flow.measure_energy(drafts)
    photographs = drafts + torch.randn(drafts.shape, generator=generator) * variance.sqrt()
    network.measure_variance(*(network.to_images(cells, (288, 288)) for cells in (drafts, photographs)))
    assert network.floor.mean() == pytest.approx(0.2, abs=0.01)
    assert network.slope.mean() == pytest.approx(0.5, abs=0.03)
    network.measure_variance(*(network.to_images(cells, (288, 288)) for cells in (drafts, drafts)))  # control: nothing is missing
    assert network.floor.max() == pytest.approx(flow.MIN_VARIANCE)
    assert network.slope.max() == pytest.approx(0, abs=1e-6)
    constant = torch.full((2, 3, 16, 16), 0.5)  # without energy: no line, but a variance
    network.measure_variance(constant, constant + 0.1 * torch.randn(constant.shape, generator=generator))
    assert network.slope.abs().max() == 0
    assert torch.isfinite(network.floor).all()


def test_cells_are_an_orthonormal_transform_of_pixels(rng: np.random.Generator) -> None:
    images = torch.from_numpy(rng.random((2, 3, 30, 42), np.float32))
    network = build_network()
    network.measure_coefficients([rng.integers(256, size=(32, 40, 3), dtype=np.uint8)])
    cells = network.to_cells(images)
    assert cells.shape == (2, 48, 8, 11)
    torch.testing.assert_close(network.to_images(cells, (30, 42)), images)
    raw = torch.from_numpy(rng.random((2, 48, 3, 3), np.float32))
    torch.testing.assert_close(transform_cells(raw).square().sum(), raw.square().sum())
    constant = transform_cells(torch.full((1, 48, 1, 1), 0.5))
    assert constant[0, 0] == pytest.approx(0.5 * 48**0.5)
    assert constant[0, 1:].abs().max() < 1e-6


def test_measured_coefficients_have_mean_zero_and_variance_one(rng: np.random.Generator) -> None:
    network = build_network()
    pictures = [photographs.read(source.path).pixels for source in photographs.list_builtin()[:3]]
    network.measure_coefficients(pictures)
    images = torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float() / 255
    cells = network.to_cells(images)
    assert cells.mean(dim=(0, 2, 3)).abs().max() < 1e-3
    torch.testing.assert_close(cells.square().mean(dim=(0, 2, 3)), torch.ones(48), atol=1e-3, rtol=0)


# ---- samples


def test_guidance_one_is_the_conditional_sample_and_zero_the_prior() -> None:
    network, points = build_network(), encode_secret(draw_features(20))
    others = encode_secret(draw_features(20, seed=9))

    def sample(points: EncodedRelease, guidance: float) -> Tensor:
        return sample_images(network, points, 2, 3, guidance, np.random.default_rng(0))

    noise = torch.from_numpy(np.random.default_rng(0).standard_normal((2, 48, *points.grid), np.float32))
    with torch.inference_mode(), flow.autocast(network):
        condition = network.build_condition(points)

        def plain(x: Tensor, time: float) -> Tensor:
            return network.predict(condition.expand(2, -1, -1, -1), x, torch.full((2,), time))

        cells = solve(plain, noise, [warp_time(step / 3) for step in range(4)])
    assert torch.equal(sample(points, 1.0), network.to_images(cells, points.size).clamp(0, 1))
    assert torch.equal(sample(points, 0.0), sample(others, 0.0))  # bit for bit
    assert not torch.equal(sample(points, 1.0), sample(others, 1.0))  # control
    assert not torch.equal(sample(points, 1.0), sample(points, 2.0))
    assert torch.equal(sample(points, 2.0), sample(points, 2.0))


def test_a_dropped_release_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    """In training, as in sampling, bit for bit. The control keeps the release."""
    network, (one, other) = build_network(), (encode_secret(draw_features(20, seed)) for seed in (1, 2))
    photograph = draw_photographs(one)

    def predict(points: EncodedRelease) -> Tensor:
        with torch.inference_mode():
            output: Tensor = network(add_noise(points, photograph, [np.random.default_rng(3)]))
        return output

    monkeypatch.setattr(flow, "DROPPED", 1.0)
    assert torch.equal(predict(one), predict(other))
    batch = add_noise(one, photograph, [np.random.default_rng(3)])
    with torch.inference_mode():
        assert not network.build_condition(batch).any()
    monkeypatch.setattr(flow, "DROPPED", 0.0)
    assert not torch.equal(predict(one), predict(other))


def test_a_draft_is_read_and_is_dropped_with_its_release(monkeypatch: pytest.MonkeyPatch) -> None:
    """A prior reads no draft, in training and in sampling, bit for bit. The controls keep it."""
    network, plain = build_network(), encode_secret(draw_features(20))
    photograph = draw_photographs(plain)
    one, other = (dataclasses.replace(plain, drafts=draw_photographs(plain, seed)) for seed in (1, 2))

    def predict(points: EncodedRelease) -> Tensor:
        with torch.inference_mode():
            output: Tensor = network(add_noise(points, photograph, [np.random.default_rng(3)]))
        return output

    def sample(points: EncodedRelease, guidance: float) -> Tensor:
        return sample_images(network, points, 2, 3, guidance, np.random.default_rng(0))

    monkeypatch.setattr(flow, "DROPPED", 1.0)
    assert torch.equal(predict(one), predict(other))
    monkeypatch.setattr(flow, "DROPPED", 0.0)
    assert not torch.equal(predict(one), predict(other))
    assert torch.equal(sample(one, 0.0), sample(other, 0.0))
    assert not torch.equal(sample(one, 1.0), sample(other, 1.0))


def test_one_release_in_ten_is_dropped() -> None:
    points = encode_secret(draw_features(5))
    photograph = draw_photographs(points)
    present = [bool(draw_weights(add_noise(points, photograph, [np.random.default_rng(seed)])).all()) for seed in range(100)]
    assert 80 <= sum(present) <= 98


def draw_weights(batch: NoisyRelease) -> Tensor:
    assert batch.weights is not None
    return batch.weights


@pytest.mark.slow
def test_a_trained_network_samples_the_photograph_of_a_release() -> None:
    """Of two photographs. Controls: with shuffled weights, and with the release of the other one, it is at the baseline."""
    secrets = []
    for seed in (1, 2):
        whole = draw_features(30, seed)
        secrets.append(dataclasses.replace(whole, keypoints=whole.keypoints / 4, size=(whole.size[0] // 4, whole.size[1] // 4)))
    points = [encode_secret(secret) for secret in secrets]
    generator = torch.Generator().manual_seed(0)
    colours = torch.rand(2, 3, 4, 4, generator=generator)
    truth = torch.nn.functional.interpolate(colours, size=points[0].size, mode="bilinear")
    torch.manual_seed(0)
    network = FlowNetwork(Shape(inputs=130, length=128, widths=(16, 16)))
    network.measure_coefficients((truth.permute(0, 2, 3, 1).numpy() * 255).astype(np.uint8))
    learner = Learner(network, Training(steps=150, batch=2, warmup=5, rate=1e-2, average=0.9))
    both = encode(
        [
            Descriptors(positions=Points(keypoints=each.keypoints), size=each.size, descriptors=each.descriptors)
            for each in secrets
        ],
        [NONE, NONE],
        1,
        "invariant",
    )
    for step in range(150):
        batch = add_noise(both, truth, [np.random.default_rng([step, index]) for index in range(2)])
        learner.learn(batch, truth, step / 150)
    network = learner.load_average()

    def measure_error(release: int, photograph: int) -> float:
        images = sample_images(network, points[release], 4, 8, 1.0, np.random.default_rng(0))
        return float((images - truth[photograph]).square().mean())

    own = max(measure_error(0, 0), measure_error(1, 1))
    others = min(measure_error(0, 1), measure_error(1, 0))
    blank = float((truth - truth.mean(dim=(0, 2, 3), keepdim=True)).square().mean())  # the best constant image
    assert own < blank / 2
    assert others > blank
    for weight in network.parameters():
        weight.data = weight.data.flatten()[torch.randperm(weight.numel(), generator=generator)].view_as(weight)
    assert min(measure_error(0, 0), measure_error(1, 1)) > blank / 1.5


# ---- training


def build_plan(**given: object) -> Plan:
    sources = photographs.list_builtin()
    data = {"photographs": sources[:2], "validation": sources[2:3], "extractor": Sift(max_keypoints=200), "widths": (8, 8)}
    targets = [Target(defense=Undefended(), supported_settings={})]
    return Plan(**{"targets": targets, "training": TINY, "model": "flow"} | data | given)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_resumed_training_is_the_same_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import bench.inversion.train as module

    monkeypatch.setattr(module, "CHECKPOINT_EVERY", 2)
    raw = tmp_path / "raw.safetensors"
    train(build_plan(model="inversion"), raw)
    drafts = Drafter(Asset(str(raw)), Sift(max_keypoints=200))
    whole = train(build_plan(drafts=drafts), tmp_path / "whole.safetensors")
    with interrupted_training(after=3):
        train(build_plan(drafts=drafts), tmp_path / "parts.safetensors")
    with pytest.raises(UserError, match="other model"):
        train(build_plan(model="inversion"), tmp_path / "parts.safetensors")
    parts = train(build_plan(drafts=drafts), tmp_path / "parts.safetensors")
    assert weights.load(tmp_path / "whole.safetensors").digest == weights.load(tmp_path / "parts.safetensors").digest
    assert whole["validation"] == parts["validation"]
    assert 0 < whole["validation"]["flow-loss"] < 10
    other = train(build_plan(drafts=drafts, training=dataclasses.replace(TINY, seed=1)), tmp_path / "other.safetensors")
    assert other["validation"] != whole["validation"]  # negative control
    with pytest.raises(UserError, match="other model"):
        train(build_plan(model="inversion"), tmp_path / "whole.safetensors")


def test_it_starts_from_an_inversion_network(rng: np.random.Generator) -> None:
    """It takes the scatter and the U-Net, so its condition has a meaning from the first step."""
    shape = Shape(inputs=130, length=128, widths=(8, 8))
    trained, points = Inverter(shape).eval(), encode_secret(draw_features(20))
    fresh = FlowNetwork(shape).eval()
    weights.initialise_from(fresh, trained, 1)
    torch.testing.assert_close(fresh.scatter(points), trained.scatter(points), rtol=0, atol=0)
    torch.testing.assert_close(fresh.refine_grid(fresh.scatter(points)), trained.refine_grid(trained.scatter(points)))
    source = build_network()
    source.measure_coefficients([rng.integers(256, size=(32, 40, 3), dtype=np.uint8)])
    weights.initialise_from(fresh, source, 1)  # another network of its kind gives everything
    for name, value in fresh.state_dict().items():
        assert torch.equal(value, source.state_dict()[name])
    with pytest.raises(UserError, match="samples photographs"):
        weights.initialise_from(Inverter(shape), fresh, 1)
    weighed = Inverter(dataclasses.replace(shape, posteriors=True))
    for network in (fresh, Inverter(shape)):
        with pytest.raises(UserError, match="reads posteriors"):
            weights.initialise_from(network, weighed, 1)


def test_hidden_positions_are_refused(tmp_path: Path) -> None:
    targets = [Target(defense=RandomLines(), supported_settings={})]
    with pytest.raises(UserError, match="--model flow: it reads points"):
        train(build_plan(targets=targets), tmp_path / "W.safetensors")


def test_only_a_network_that_samples_photographs_reads_drafts() -> None:
    with pytest.raises(UserError, match="only --model flow reads drafts"):
        build_plan(model="inversion", drafts=Drafter(Asset("shipped"), Sift()))


@pytest.mark.slow
def test_the_attack_reads_drafts_of_the_network_of_the_training(tmp_path: Path) -> None:
    """With another network for drafts, or none, it does not apply."""
    extractor, raw, other, out = Sift(max_keypoints=200), *(tmp_path / f"{name}.safetensors" for name in "abc")
    train(build_plan(model="inversion"), raw)
    train(build_plan(model="inversion", training=dataclasses.replace(TINY, seed=1)), other)
    drafts = Drafter(Asset(str(raw)), extractor)
    meta = train(build_plan(drafts=drafts), out)
    assert meta["drafts"] == {"none": weights.load(raw).digest}
    assert train(build_plan(drafts=drafts), out)["validation"] == meta["validation"]  # finished
    with pytest.raises(UserError, match="other drafts"):
        train(build_plan(), out)
    attack = Generative(weights=Asset(str(out)), drafts=Asset(str(raw)), steps=2)
    check_attack(attack, Undefended(), extractor, draw_features(20))
    wrong = dataclasses.replace(attack, drafts=Asset(str(other)))
    assert "generative:drafts=FILE" in explain(wrong, Undefended(), extractor)
    assert "generative:drafts=FILE" in explain(dataclasses.replace(attack, drafts=Asset("shipped")), Undefended(), extractor)
    assert dict(attack.assets(Undefended(), extractor, Public()))["drafts"] == weights.load(raw).digest
    plain = tmp_path / "plain.safetensors"
    train(build_plan(), plain)
    without = Generative(weights=Asset(str(plain)), steps=2)
    assert dict(without.assets(Undefended(), extractor, Public()))["drafts"] == UNUSED
    for given, reason in ((UNUSED, "None"), (str(raw), "reads no drafts; omit generative:drafts")):
        assert reason in explain(dataclasses.replace(without, drafts=Asset(given)), Undefended(), extractor)
    with pytest.raises(UserError, match="no network makes drafts for ldp"):
        drafts.digest(LDP(), Public())
    narrow = Target(defense=LDP(), supported_settings={"epsilon": Between(8.0, 20.0)})
    with pytest.raises(UserError, match="no network makes drafts for ldp"):  # at the greatest setting
        find_drafts([narrow], Drafter(Asset("shipped"), Sift()))


# ---- the attack


@pytest.mark.slow
def test_one_network_for_several_defenses(tmp_path: Path) -> None:
    """It starts from a network for raw descriptors. The attack applies to the defenses of the training alone."""
    words, raw, out = write_dictionary(tmp_path), tmp_path / "raw.safetensors", tmp_path / "W.safetensors"
    extractor = Sift(max_keypoints=200)
    train(build_plan(model="inversion"), raw)
    ldp = LDP(dictionary=words, subset_size=2)
    settings = {"epsilon": Between(8.0, 16.0), "subset_size": OneOf((1, 2))}
    targets = [Target(defense=Undefended(), supported_settings={}), Target(defense=ldp, supported_settings=settings)]
    train(build_plan(targets=targets, initial_checkpoint=raw), out)
    attack = Generative(weights=Asset(str(out)), steps=2, samples=2)
    for defense in (Undefended(), ldp):
        assert attack.explain_not_applicable(defense, extractor, Public()) is None
        check_attack(attack, defense, extractor, draw_features(20))
    assert "trained for epsilon 8 to 16" in explain(attack, dataclasses.replace(ldp, epsilon=20), extractor)
    assert "trained for ldp, none" in explain(attack, Affine(database=words), extractor)
    assert "network that samples photographs" in explain(DIA(weights=Asset(str(out))), Undefended(), extractor)
    assert "network that reconstructs the photograph" in explain(Generative(weights=Asset(str(raw))), Undefended(), extractor)


def explain(attack: Generative | DIA, defense: Undefended | LDP | Affine, extractor: Sift) -> str:
    return str(attack.explain_not_applicable(defense, extractor, Public()))


@pytest.mark.slow
def test_bench_trains_and_runs_the_attack(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On subspaces. The mean of samples is another image than one sample, and the prior is another than both."""
    words, sources = write_dictionary(tmp_path, 1000), photographs.list_builtin()
    for folder, source in (("train", sources[0]), ("unseen", sources[1])):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / source.path.name).write_bytes(source.path.read_bytes())
    out, unseen = tmp_path / "W.safetensors", str(tmp_path / "unseen")
    affine = f"affine:dim=2,database={words},sub_databases=1"
    command = ["train", "--model", "flow", "--defense", affine, "--images", str(tmp_path / "train"), "--validation", unseen]
    assert main([*command, "--widths", "8,8", "--steps", "2", "--batch", "2", "--out", str(out)]) == 0
    assert "flow-loss" in capsys.readouterr().out
    assert weights.load(out).meta["model"] == "flow"
    run = ["run", "--defense", affine, "--images", unseen, "--out", str(tmp_path / "r")]
    attacks = [f"generative:weights={out},steps=1{more}" for more in ("", ",samples=3", ",guidance=0")]
    assert main([*run, *(word for attack in attacks for word in ("--attack", attack))]) == 0
    assert bench.load_records(tmp_path / "r")["metrics.ssim"].nunique() == 3


def test_it_does_not_apply_to_hidden_positions() -> None:
    assert "reads Points" in str(Generative().explain_not_applicable(RandomLines(), Sift(), Public()))


def test_a_prior_computes_no_draft(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shipped network reads drafts, and as a prior it reads nothing of the release. The control needs a draft."""

    def fail(*_: object) -> None:
        raise AssertionError("computed")

    public, defense = Public(), Undefended()
    release = defense.protect(draw_features(20), public, np.random.default_rng(0))
    view = View(release=release, defense=defense, extractor=Sift(), knowledge={PublicAssets: lambda: PublicAssets(assets=public)})
    monkeypatch.setattr(Drafter, "__call__", fail)
    with pytest.raises(AssertionError, match="computed"):
        Generative(steps=1).sample(view, np.random.default_rng(0))
    monkeypatch.setattr(FlowNetwork, "build_condition", fail)
    assert Generative(steps=1, guidance=0.0).sample(view, np.random.default_rng(0)).shape == (1, *release.size, 3)


@pytest.mark.parametrize("fields", [{"samples": 0}, {"steps": 0}, {"guidance": -1.0}, {"guidance": math.nan}])
def test_fields_have_limits(fields: Mapping[str, float]) -> None:
    with pytest.raises(UserError, match="at least"):
        Generative(**fields)  # type: ignore[arg-type]


@pytest.mark.slow
def test_drafts_and_positions_serve_all_kinds_of_releases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also subspaces beside others. The network of `dia` makes each draft."""
    import bench.inversion.train as module

    monkeypatch.setattr(module, "TOLERANCE", 0.5)  # of errors on single photographs
    defenses = (Undefended(), Affine(dim=2), LDP(epsilon=16.0))
    targets = [Target(defense=defense, supported_settings={}) for defense in defenses]
    drafts, out = Drafter(Asset("shipped"), Sift()), tmp_path / "W.safetensors"
    given = {"targets": targets, "extractor": Sift(), "drafts": drafts}
    with pytest.raises(UserError, match="--encoding positions --drafts shipped"):
        train(build_plan(**given), out)
    meta = train(build_plan(**given, encoding="positions", training=dataclasses.replace(TINY, rate=1e-9)), out)
    assert sorted(meta["drafts"]) == ["affine", "ldp", "none"]
    attack, sources = Generative(weights=Asset(str(out)), steps=4), [photographs.list_builtin()[0].path]
    records = bench.run(list(defenses), [attack, DIA()], sources)
    for record in records:  # hardly trained, so it samples around the draft, which is one of the eight that `dia` averages
        assert record["metrics"]["identified"] > 0.5
    (prior,) = bench.run([Undefended()], [dataclasses.replace(attack, guidance=0.0)], sources)  # the control reads no draft
    assert prior["metrics"]["identified"] < 0.1
