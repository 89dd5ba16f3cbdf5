"""The network that reads lines: encoding, training, and the attack `dia-lines`."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import interrupted_training

from attacks.dia_lines import DIALines
from bench.cli import main
from bench.codebook.examples import draw_features, write_dictionary
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.inversion import weights
from bench.inversion.data import Target
from bench.inversion.encoding import EncodedLines, encode, encode_lines
from bench.inversion.learner import Learner
from bench.inversion.line_network import SAMPLES, LineInverter
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Plan, Training
from bench.inversion.reconstruct import infer, locate_keypoints, run_network
from bench.inversion.symmetry import IDENTITY, Symmetry
from bench.inversion.train import train
from bench.positions.lines import draw_lines
from bench.registry.composed import Composed
from bench.settings import Asset, Between
from bench.testing import check_attack
from bench.types import Descriptors, Features, Lines, Points
from defenses.ldp import LDP
from defenses.lines import RandomLines
from defenses.none import Undefended
from defenses.permutation import Permutation

NONE = np.empty(0, np.float32)
TINY = Training(steps=4, batch=2, warmup=2)

pytestmark = pytest.mark.usefixtures("narrow_networks")


def build_shape(length: int, samples: int = 16, widths: tuple[int, ...] = (8, 8)) -> Shape:
    return Shape(inputs=length + 2, length=length, widths=widths, samples=samples)


def release_lines(secret: Features, rng: np.random.Generator) -> Descriptors:
    lines = draw_lines(secret.keypoints, rng.uniform(0, np.pi, len(secret)))
    return Descriptors(positions=lines, size=secret.size, descriptors=secret.descriptors)


def encode_secret(secret: Features, rng: np.random.Generator, samples: int = 16) -> EncodedLines:
    return encode_lines([release_lines(secret, rng)], [NONE], 1, "invariant", samples, [secret.keypoints])


def test_the_true_sample_is_the_nearest(rng: np.random.Generator) -> None:
    secret = draw_features(20)
    lines = encode_secret(secret, rng, 64)
    assert lines.truth is not None
    distances = (lines.samples * 4 - torch.from_numpy(secret.keypoints)[:, None]).norm(dim=2)
    assert (distances.argmin(dim=1) == lines.truth).all()
    assert distances.min(dim=1).values.max() <= np.hypot(*secret.size) / 64 / 2 + 1e-2  # half the distance of two samples


def test_points_on_lines_are_encoded_as_points(rng: np.random.Generator) -> None:
    secret, settings = draw_features(20), [np.array([0.25], np.float32)]
    positions = Points(keypoints=secret.keypoints)
    release = Descriptors(positions=positions, size=secret.size, descriptors=secret.descriptors)
    points = encode([release], settings, 1, "invariant")
    lines = encode_lines([release_lines(secret, rng)], settings, 1, "invariant", 4)
    picked = lines.pick_points(points.coordinates[:, None], torch.ones(20, 1))
    torch.testing.assert_close(picked.values, points.values)
    network = Inverter(Shape(inputs=131, length=128, widths=(8, 8))).eval()
    expected = infer(network, points)
    torch.testing.assert_close(infer(network, picked), expected)
    unweighted = infer(network, dataclasses.replace(picked, weights=torch.zeros(20)))
    assert not torch.allclose(unweighted, expected)  # control


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("defense", [RandomLines(), Permutation()], ids=["lines", "permutation"])
def test_transformed_lines_pass_through_the_transformed_keypoints(
    defense: RandomLines | Permutation, mirrored: bool, turns: int, rng: np.random.Generator
) -> None:
    secret = dataclasses.replace(draw_features(20), size=(256, 300))
    symmetry = Symmetry(mirrored, turns, None)
    moved = symmetry.transform_release(defense.protect(secret, Public(), rng))
    points = symmetry.transform_points(secret.keypoints, secret.size)
    assert isinstance(moved.positions, Lines)
    lines = moved.positions.lines
    np.testing.assert_allclose((lines[:, :2] * points).sum(axis=1) + lines[:, 2], 0, atol=1e-3)
    assert moved.size == ((300, 256) if turns % 2 else (256, 300))


def test_the_samples_of_a_mirrored_line_are_reversed(rng: np.random.Generator) -> None:
    release = release_lines(draw_features(20), rng)
    samples = encode_lines([release], [NONE], 1, "invariant", 8).samples.numpy() * 4
    for mirrored, turns in ((False, 1), (True, 0), (True, 3)):
        symmetry = Symmetry(mirrored, turns, None)
        moved = encode_lines([symmetry.transform_release(release)], [NONE], 1, "invariant", 8).samples.numpy() * 4
        expected = symmetry.transform_points(samples.reshape(-1, 2), release.size).reshape(samples.shape)
        np.testing.assert_allclose(moved, expected[:, ::-1] if mirrored else expected, atol=1e-2)


def test_the_order_of_the_keypoints_has_no_effect(rng: np.random.Generator) -> None:
    network, secret = LineInverter(build_shape(128)).eval(), draw_features(30)
    release, order = release_lines(secret, rng), rng.permutation(30)
    shuffled = dataclasses.replace(release, positions=release.positions.take(order), descriptors=release.descriptors[order])
    with torch.inference_mode():
        one, other = (run_network(network, encode_lines([each], [NONE], 1, "invariant", 16)) for each in (release, shuffled))
    torch.testing.assert_close(one.logs[order], other.logs, atol=1e-4, rtol=1e-4)


@pytest.mark.slow
def test_a_trained_network_locates_keypoints() -> None:
    """On new lines through the keypoints of the training. Control: with shuffled weights it is not much better than chance."""
    whole, generator = draw_features(30), torch.Generator().manual_seed(0)
    secret = dataclasses.replace(whole, keypoints=whole.keypoints / 2, size=(whole.size[0] // 2, whole.size[1] // 2))
    torch.manual_seed(0)
    learner = Learner(LineInverter(build_shape(128)), Training(steps=60, batch=1, warmup=5, rate=1e-2, average=0.9))
    photograph = torch.rand(1, 3, *secret.size[::-1], generator=generator)
    for step in range(60):
        learner.learn(encode_secret(secret, np.random.default_rng(step)), photograph, step / 60)
    network, release = learner.load_average(), release_lines(secret, np.random.default_rng(1000))

    def measure_error() -> float:
        located = locate_keypoints(network, release, [IDENTITY], NONE, 1, "invariant")
        return float(np.median(np.linalg.norm(located - secret.keypoints, axis=1)))

    trained = measure_error()
    for weight in network.parameters():
        weight.data = weight.data.flatten()[torch.randperm(weight.numel(), generator=generator)].view_as(weight)
    shuffled = measure_error()
    samples = encode_lines([release], [NONE], 1, "invariant", 16).samples.numpy() * 4
    random = samples[np.arange(30), np.random.default_rng(0).integers(16, size=(100, 30))]
    chance = float(np.median(np.linalg.norm(random - secret.keypoints, axis=2)))
    assert trained < chance / 2
    assert shuffled > chance / 1.5


def test_it_takes_the_inversion_network_of_points() -> None:
    """Narrower levels take the first channels."""
    trained = Inverter(build_shape(128, 0, (8, 12)))
    for widths in ((8, 12), (8, 6)):
        fresh = LineInverter(build_shape(128, 16, widths))
        weights.initialise_from(fresh, trained, 1)
        for name, value in fresh.inverter.state_dict().items():
            torch.testing.assert_close(value, trained.state_dict()[name][tuple(map(slice, value.shape))])
    again = LineInverter(build_shape(128, 16, (8, 6)))
    weights.initialise_from(again, fresh, 1)
    for name, value in again.state_dict().items():
        torch.testing.assert_close(value, fresh.state_dict()[name])
    with pytest.raises(UserError, match="other sizes"):
        weights.initialise_from(LineInverter(build_shape(128, 16, (8, 14))), trained, 1)
    with pytest.raises(UserError, match="reads lines"):
        weights.initialise_from(Inverter(build_shape(128, 0)), LineInverter(build_shape(128)), 1)


# ---- training


def build_plan(**given: object) -> Plan:
    sources = photographs.list_builtin()
    data = {"photographs": sources[:2], "validation": sources[2:3], "extractor": Sift(max_keypoints=200), "widths": (8, 8)}
    targets = [Target(defense=RandomLines(), supported_settings={})]
    return Plan(**{"targets": targets, "training": TINY} | data | given)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_resumed_training_is_the_same_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import bench.inversion.train as module

    monkeypatch.setattr(module, "CHECKPOINT_EVERY", 2)
    whole = train(build_plan(), tmp_path / "whole.safetensors")
    with interrupted_training(after=3):
        train(build_plan(), tmp_path / "parts.safetensors")
    parts = train(build_plan(), tmp_path / "parts.safetensors")
    assert weights.load(tmp_path / "whole.safetensors").digest == weights.load(tmp_path / "parts.safetensors").digest
    assert whole["validation"] == parts["validation"]
    assert 0 < whole["validation"]["position-error"] < 256
    other = train(build_plan(training=dataclasses.replace(TINY, seed=1)), tmp_path / "other.safetensors")
    assert other["validation"] != whole["validation"]  # negative control


@pytest.mark.slow
def test_a_network_for_a_composed_defense(tmp_path: Path) -> None:
    words = write_dictionary(tmp_path)
    extractor, out = Sift(max_keypoints=200), tmp_path / "W.safetensors"

    def compose(geometry: RandomLines | Permutation | None = None, subset_size: int = 2, epsilon: float = 10) -> Composed:
        descriptors = LDP(dictionary=words, subset_size=subset_size, epsilon=epsilon)
        return Composed(geometry=geometry or RandomLines(), descriptors=descriptors)

    train(build_plan(targets=[Target(defense=compose(), supported_settings={"epsilon": Between(8.0, 16.0)})]), out)
    attack = DIALines(weights=Asset(str(out)))

    def explain(defense: Composed | RandomLines) -> str:
        return str(attack.explain_not_applicable(defense, extractor, Public()))

    assert explain(compose()) == "None"
    assert "trained for epsilon 8 to 16" in explain(compose(epsilon=20))
    assert "trained for subset_size 2" in explain(compose(subset_size=3))
    assert "trained for lines+ldp" in explain(compose(geometry=Permutation()))
    assert "trained for lines+ldp" in explain(RandomLines())
    check_attack(attack, compose(), extractor, draw_features(20))


def test_points_and_lines_need_networks_of_their_own(tmp_path: Path) -> None:
    targets = [Target(defense=defense, supported_settings={}) for defense in (RandomLines(), Undefended())]
    with pytest.raises(UserError, match="reads no points"):
        train(build_plan(targets=targets), tmp_path / "W.safetensors")
    with pytest.raises(UserError, match="needs the encoding invariant"):
        train(build_plan(encoding="positions"), tmp_path / "W.safetensors")


@pytest.mark.slow
def test_bench_trains_and_runs_the_attack(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sources = photographs.list_builtin()
    for folder, source in (("train", sources[0]), ("unseen", sources[1])):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / source.path.name).write_bytes(source.path.read_bytes())
    out, unseen = tmp_path / "W.safetensors", str(tmp_path / "unseen")
    command = ["train", "--defense", "lines", "--images", str(tmp_path / "train"), "--validation", unseen]
    assert main([*command, "--widths", "8,8", "--steps", "2", "--batch", "2", "--out", str(out)]) == 0
    assert "position-error" in capsys.readouterr().out
    assert weights.load(out).meta["shape"]["samples"] == SAMPLES
    run = ["run", "--defense", "lines", "--images", unseen, "--out", str(tmp_path / "r")]
    assert main([*run, "--attack", f"dia-lines:weights={out}"]) == 0
    assert "position-error" in capsys.readouterr().out


def test_it_does_not_apply_to_points() -> None:
    assert "reads Lines" in str(DIALines().explain_not_applicable(Undefended(), Sift(), Public()))
