"""Muon for matrices, AdamW for the rest."""

import pytest
import torch
from torch import nn

from bench.inversion.optimizer import Optimizer

RATE, DECAY = 0.01, 0.1
MATRICES = "0.weight", "2.weight", "4.weight"


@pytest.fixture
def module():
    torch.manual_seed(0)
    layers = nn.Sequential(nn.Conv2d(4, 6, 3), nn.BatchNorm2d(6), nn.Conv2d(6, 5, 1), nn.Flatten(), nn.Linear(5 * 9, 3))
    return layers.to(memory_format=torch.channels_last)


def learn(module, optimizer, seed):
    images = torch.randn(7, 4, 5, 5, generator=torch.Generator().manual_seed(seed))
    module.zero_grad()
    (module(images) ** 2).sum().backward()
    optimizer.step()


def take_step(module, optimizer):
    """Return the weights before a step, the gradients, and the weights after it."""
    before = {name: weight.detach().clone() for name, weight in module.named_parameters()}
    learn(module, optimizer, 0)
    named = dict(module.named_parameters())
    return before, {name: weight.grad.clone() for name, weight in named.items()}, {name: w.detach() for name, w in named.items()}


def test_each_direction_of_a_matrix_moves_about_equally_far(module):
    """This includes convolutions. The directions of the gradient itself differ more (negative control)."""
    before, gradients, after = take_step(module, Optimizer(module, RATE, decay=0.0))
    for name in MATRICES:
        moved, gradient = (before[name] - after[name]).flatten(1), gradients[name].flatten(1)
        far = torch.linalg.svdvals(moved) / (0.2 * RATE * max(moved.shape) ** 0.5)
        assert far.min() > 0.6
        assert far.max() < 1.3
        own = torch.linalg.svdvals(gradient)
        assert own.max() > 5 * own.min()


@pytest.mark.skipif(not hasattr(torch.optim, "Muon"), reason="torch.optim.Muon is the reference, since torch 2.9")
def test_a_convolution_is_updated_as_a_matrix(module):
    """The reference is PyTorch's Muon on the flattened weight."""
    before, gradients, after = take_step(module, Optimizer(module, RATE, DECAY))
    for name in MATRICES:
        reference = nn.Parameter(before[name].flatten(1).clone())
        reference.grad = gradients[name].flatten(1).clone()
        torch.optim.Muon([reference], RATE, weight_decay=DECAY, adjust_lr_fn="match_rms_adamw").step()
        torch.testing.assert_close(after[name].flatten(1), reference.detach(), rtol=0, atol=0.02 * RATE)  # it rounds to bf16
        assert (after[name] - before[name]).abs().max() > 0.1 * RATE


def test_weights_that_are_no_matrix_follow_adamw(module):
    before, gradients, after = take_step(module, Optimizer(module, RATE, DECAY))
    for name in ("0.bias", "1.weight", "1.bias", "4.bias"):
        reference = nn.Parameter(before[name].clone())
        reference.grad = gradients[name].clone()
        torch.optim.AdamW([reference], RATE, weight_decay=DECAY).step()
        torch.testing.assert_close(after[name], reference.detach())


@pytest.mark.parametrize("restored", [True, False])
def test_a_restored_state_gives_the_same_steps(module, restored):
    """Without the state they differ (negative control)."""
    optimizer = Optimizer(module, RATE, DECAY)
    for seed in range(3):
        learn(module, optimizer, seed)
    weights = {name: value.clone() for name, value in module.state_dict().items()}
    state = {name: value.clone() for name, value in optimizer.state().items()}
    learn(module, optimizer, 3)
    expected = {name: value.clone() for name, value in module.state_dict().items()}

    module.load_state_dict(weights)
    again = Optimizer(module, RATE, DECAY)
    if restored:
        again.restore(state)
    learn(module, again, 3)
    same = [
        torch.equal(value, expected[name]) for name, value in module.state_dict().items() if name.endswith(("weight", "bias"))
    ]
    assert all(same) == restored
    assert restored or not any(same)


def test_the_rate_is_shared_by_both(module):
    optimizer = Optimizer(module, RATE, DECAY)
    optimizer.rate = 0.0
    before, _, after = take_step(module, optimizer)
    assert optimizer.rate == 0
    for name, weight in before.items():
        torch.testing.assert_close(after[name], weight, rtol=0, atol=0)


def test_a_weight_without_gradient_stays(module):
    optimizer = Optimizer(module, RATE, DECAY)
    module[0].requires_grad_(False)
    before, after = module[0].weight.clone(), module[0].weight
    learn(module, optimizer, 0)
    assert torch.equal(before, after)
