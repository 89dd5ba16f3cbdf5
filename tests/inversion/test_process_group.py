"""Training on several devices: two processes compute the same as one with the whole batch."""

import os

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import distributed, nn

import bench.inversion.train as inversion
from bench.cli import main
from bench.extractors.sift import Sift
from bench.images import photographs
from bench.inversion import learner, norm, reconstruct, weights
from bench.inversion.data import Target
from bench.inversion.network import Shape
from bench.inversion.plan import PROFILES, Plan, Training
from bench.inversion.process_group import ProcessGroup, launch
from defenses.none import Undefended

pytestmark = pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="two processes need two cores")


def normalise(module, images):
    """Return output, gradient of the input for a nonlinear loss, running statistics and gradient of the scale."""
    images = images.clone().requires_grad_()
    output = module(images)
    (output**3).sum().backward()
    return output.detach(), images.grad, module.running_mean, module.running_var, module.weight.grad


def run_half(rank, folder, jointly):
    distributed.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    module = nn.Sequential(nn.BatchNorm2d(3, dtype=torch.float64))
    if jointly:
        norm.convert_batch_norms(module)
    part = torch.load(folder / "images")[2 * rank : 2 * rank + 2]
    torch.save(normalise(module[0], part), folder / f"found-{rank}")
    distributed.destroy_process_group()


@pytest.mark.parametrize(
    "jointly", [pytest.param(True, marks=pytest.mark.slow), pytest.param(False, marks=pytest.mark.exhaustive)]
)
def test_batch_norm_is_over_the_batch_of_both_processes(jointly, tmp_path):
    """PyTorch's batch norm over the part of each process differs (negative control)."""
    torch.manual_seed(0)
    images = torch.randn(4, 3, 5, 6, dtype=torch.float64) + torch.arange(4)[:, None, None, None]
    torch.save(images, tmp_path / "images")
    torch.multiprocessing.spawn(run_half, (tmp_path, jointly), nprocs=2)
    first, second = (torch.load(tmp_path / f"found-{rank}") for rank in range(2))
    output, gradient, mean, variance, scale = normalise(nn.BatchNorm2d(3, dtype=torch.float64), images)
    together = [
        (torch.cat([first[0], second[0]]), output),
        (torch.cat([first[1], second[1]]), gradient),
        (first[2], mean),
        (second[2], mean),
        (first[3], variance),
        (first[4] + second[4], scale),
    ]
    same = [torch.allclose(found, expected, rtol=1e-9, atol=1e-12) for found, expected in together]
    assert all(same) if jointly else not any(same)


def read_losses(folder):
    events = EventAccumulator(str(folder))
    events.Reload()
    return np.array([event.value for event in events.Scalars("loss")])


def train_in_single_precision(*given):
    """Train and reconstruct a small network without rounding to half precision, which grows from step to step."""
    Shape.__init__.__kwdefaults__.update(SMALL)
    learner.pick_dtype = reconstruct.pick_dtype = lambda device: torch.float32
    return inversion.train_worker(*given)


def restore_after_test(monkeypatch):
    for module in (learner, reconstruct):
        monkeypatch.setattr(module, "pick_dtype", module.pick_dtype)
    for name in SMALL:
        monkeypatch.setitem(Shape.__init__.__kwdefaults__, name, getattr(Shape, name))


def train_without_joint_norms(*given):
    norm.convert_batch_norms = lambda module: None  # in a process of its own
    return train_in_single_precision(*given)


def build_arguments(folder, name):
    """Build the arguments of `train_worker` after the group."""
    sources = photographs.list_builtin()
    plan = Plan(
        targets=[Target(defense=Undefended(), supported_settings={})],
        photographs=sources[:2],
        validation=sources[2:3],
        extractor=Sift(),
        widths=(8, 8),
        training=SHORT,
    )
    return plan, folder / name, folder / f"log-{name}"


SMALL = {"hidden": 32, "painted": 4}
# First steps are signs of gradients, or orthogonal, so rounding changes the smallest parts; at a low rate this has little effect.
SHORT = Training(steps=4, batch=4, warmup=2, rate=1e-4)
PROCESSES = {
    "one": (1, train_in_single_precision),
    "two": (2, train_in_single_precision),
    "separate": (2, train_without_joint_norms),
}


@pytest.mark.exhaustive
def test_two_processes_train_as_one_with_the_whole_batch(tmp_path, monkeypatch):
    """Losses and scores are equal. They differ if each process normalises its own part (negative control)."""
    restore_after_test(monkeypatch)
    found = {}
    for name, (devices, function) in PROCESSES.items():
        meta = launch(devices, SHORT.batch, function, *build_arguments(tmp_path, name))
        found[name] = read_losses(tmp_path / f"log-{name}"), meta["validation"]["ssim"]
    assert len(found["two"][0]) == SHORT.steps
    np.testing.assert_allclose(found["two"][0], found["one"][0], rtol=1e-5)
    assert found["two"][1] == pytest.approx(found["one"][1], abs=1e-5)
    assert np.abs(found["separate"][0] / found["one"][0] - 1).max() > 1e-4
    one, two = (weights.load(tmp_path / name) for name in ("one", "two"))
    assert one.meta.keys() == two.meta.keys()
    assert not list(tmp_path.glob("*.checkpoint"))


@pytest.mark.exhaustive
def test_two_processes_resume_the_training_of_one(tmp_path, monkeypatch):
    restore_after_test(monkeypatch)
    monkeypatch.setattr(inversion, "CHECKPOINT_EVERY", 1)
    advance = inversion._Trainer._advance

    def interrupted(self, *given):
        if self.step == 2:
            raise KeyboardInterrupt
        return advance(self, *given)

    launch(1, SHORT.batch, train_in_single_precision, *build_arguments(tmp_path, "whole"))
    monkeypatch.setattr(inversion._Trainer, "_advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        launch(1, SHORT.batch, train_in_single_precision, *build_arguments(tmp_path, "parts"))
    launch(2, SHORT.batch, train_in_single_precision, *build_arguments(tmp_path, "parts"))
    assert len(read_losses(tmp_path / "log-parts")) == SHORT.steps  # two steps of one, two of both
    np.testing.assert_allclose(read_losses(tmp_path / "log-parts"), read_losses(tmp_path / "log-whole"), rtol=1e-5)


@pytest.mark.exhaustive
def test_a_user_error_in_a_process_is_reported_in_one_line(tmp_path, capsys):
    folder = tmp_path / "photos"
    folder.mkdir()
    (folder / "a.png").write_bytes(photographs.list_builtin()[0].path.read_bytes())
    command = ["train", "--defense", "none", "--images", str(folder), "--validation", str(folder), "--out", str(tmp_path / "W")]
    assert main([*command, "--devices", "2"]) == 2
    assert "1 photographs are in both the training and the validation set" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "message"), [(("--devices", "4096"), "must be from 1 to"), (("--devices", "2", "--batch", "3"), "a multiple of 2")]
)
def test_missing_devices_and_unequal_parts_are_refused(words, message, tmp_path, capsys):
    folder = tmp_path / "photos"
    folder.mkdir()
    for source in photographs.list_builtin()[:2]:
        (folder / source.path.name).write_bytes(source.path.read_bytes())
    assert main(["train", "--defense", "none", "--images", str(folder), "--out", str(tmp_path / "W"), *words]) == 2
    assert message in capsys.readouterr().err


def test_the_parts_form_the_batch():
    assert [index for rank in range(3) for index in ProcessGroup(rank, 3).assign_indices(12)] == list(range(12))
    assert list(ProcessGroup().assign_indices(5)) == list(range(5))


def test_the_papers_profile_has_coarsenets_widths():
    assert PROFILES["paper"].widths == (256, 256, 256, 512, 512, 512)
