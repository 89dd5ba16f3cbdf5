"""A training step: its effect, and its speed relative to matrix products."""

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from bench.core.device import pick_dtype
from bench.inversion.encoding import EncodedRelease, encode
from bench.inversion.learner import Learner
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Training
from bench.types import Descriptors, Points

BATCH, KEYPOINTS = 8, 600
SIDE = 2048  # of the square matrix in the product that is the reference


def batch(rng: np.random.Generator, count: int = BATCH) -> tuple[EncodedRelease, torch.Tensor]:
    releases = [
        Descriptors(
            positions=Points(keypoints=rng.uniform(0, 256, (KEYPOINTS, 2)).astype(np.float32)),
            size=(256, 256),
            descriptors=rng.normal(size=(KEYPOINTS, 128)).astype(np.float32),
        )
        for _ in range(count)
    ]
    points = encode(releases, [np.empty(0, np.float32)] * count, 1, "invariant")
    return points, torch.from_numpy(rng.random((count, 3, 256, 256)).astype(np.float32))


@pytest.mark.slow
def test_the_average_follows_its_formula(rng):
    """After the first steps the average follows its formula."""
    learner = Learner(Inverter(Shape(inputs=130, widths=(8, 8))), Training(steps=3, batch=1, warmup=1))
    name = "own.weight"
    expected = learner.module.state_dict()[name].clone()
    for step in range(3):
        learner.learn(*batch(rng, 1), progress=step / 3)
        decay = (step + 1) / (step + 10)
        expected = decay * expected + (1 - decay) * learner.module.state_dict()[name]
    torch.testing.assert_close(learner.average[name], expected)
    last = learner.module.state_dict()[name].clone()
    assert not torch.equal(learner.load_average().state_dict()[name], last)


@pytest.mark.slow
def test_the_rate_rises_and_then_falls_to_zero(rng):
    learner = Learner(Inverter(Shape(inputs=130, widths=(8, 8))), Training(steps=9, batch=1, warmup=2, rate=1e-3))
    rates = []
    for progress in (-1.0, -0.5, 0.0, 0.5, 1.0):
        learner.learn(*batch(rng, 1), progress=progress)
        rates.append(learner.optimizer.rate)
    assert rates == pytest.approx([5e-4, 1e-3, 1e-3, 5e-4, 0])


GROUP = pytest.mark.benchmark(group="a step of training")


@pytest.fixture
def ready(rng):
    """A learner, a batch, and the operations of a step."""
    torch.manual_seed(0)
    learner, given = Learner(Inverter(Shape(inputs=130)), Training()), batch(rng)
    with FlopCounterMode(display=False) as counted:
        learner.learn(*given, progress=0)
    return learner, given, counted.get_total_flops()


@GROUP
def test_speed_of_a_step(benchmark, ready):
    """Eight crops, forward and backward; 8 divided by the seconds is images per second."""
    learner, given, operations = ready
    benchmark.extra_info["operations"] = operations
    benchmark(learner.learn, *given, progress=0)


@GROUP
def test_speed_of_the_bare_products(benchmark, ready):
    """The floor of a step's time: its operations as one product of large matrices in the same precision."""
    learner, _, operations = ready
    dtype = pick_dtype(learner.device)
    left, right = (torch.randn(rows, SIDE).to(dtype) for rows in (round(operations / (2 * SIDE**2)), SIDE))
    benchmark(lambda: left @ right)
