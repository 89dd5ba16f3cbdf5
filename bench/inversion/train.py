"""Trains the network that an attacker would, for the releases of one defense.

Each example of a step is a function of (seed, step, place in the batch) alone, so that a resumed training is the same training,
and several processes make one batch.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.api import Asset, Defense, OneOf
from bench.codebook.public import Public
from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.formats import tensor_file
from bench.images.views import OnDemand, PhotographView, collect, photographs_of
from bench.inversion import weights
from bench.inversion.data import Example, Examples, Served, check_lengths, fitting_dictionaries, quantisation_error, quantise
from bench.inversion.encoding import Encoding, Points, encode, stack
from bench.inversion.learner import Learner
from bench.inversion.log import Log
from bench.inversion.loss import ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Plan, Training
from bench.inversion.process_group import Team, launch
from bench.inversion.reconstruct import paint
from bench.inversion.symmetry import OF_POSITIONS, symmetries
from bench.types import WordSets

CHECKPOINT = "inversion-checkpoint"
CHECKPOINT_EVERY = 250  # steps
VALIDATE_AT_MOST = 100  # photographs
IN_MEMORY = 2000  # photographs, about 6 GB; of more, views are made whenever they are needed
COMPARED = 1000  # training photographs, at most, whose quantisation error is compared with that on unseen ones
TOLERANCE = 0.05  # between the quantisation errors on training and on unseen photographs


def train(plan: Plan, out: Path, log: Path | None = None, devices: int = 1) -> dict[str, Any]:
    """Train, or resume, a network, and return its metadata. What is done is not done again.

    Parameters
    ----------
    out : the weights' file; a checkpoint is kept beside it until training is done
    log : folder for TensorBoard: loss, rate and speed of each step, and the validation's scores
    devices : how many share each batch; what comes out is the same but for rounding

    Raises
    ------
    UserError
        if photographs are in both sets, no photograph can be used, or `out` or its checkpoint is of another training; there
        is to be a log, and tensorboard is not installed; or there are too few devices.
    """
    return launch(devices, plan.training.batch, take_part, plan, out, log)


def take_part(team: Team, plan: Plan, out: Path, log: Path | None) -> dict[str, Any]:
    """One process's part of `train`."""
    written = Log(log if team.leads else None)
    defense, extractor, encoding, training = plan.defense, plan.extractor, plan.encoding, plan.training
    shared = {source.content_hash() for source in plan.photographs} & {source.content_hash() for source in plan.validation}
    if shared:
        raise UserError(f"{len(shared)} photographs are in both the training and the validation set")
    few = len(plan.photographs) <= IN_MEMORY
    views = collect(list(plan.photographs), extractor) if few else OnDemand(plan.photographs, extractor)
    unseen = collect(list(plan.validation), extractor)[::4]  # as they are, at 256 pixels
    examples, held_out, errors = _examples(plan, views, unseen)
    moved = OF_POSITIONS if encoding == "positions" else symmetries(extractor)
    examples = dataclasses.replace(examples, symmetries=moved)
    slots, length = _stacked(defense, held_out, unseen[0], encoding)
    sample = encode([(first := held_out.whole(unseen[0], np.random.default_rng(0))).release], [first.condition], slots, encoding)
    one_by_one = slots if encoding == "invariant" and defense.releases is WordSets else 0
    shape = Shape(inputs=sample.values.shape[1], candidates=one_by_one, length=length, widths=plan.widths)
    start = None if plan.start is None else weights.load(plan.start)
    meta = {
        **weights.describe(defense, dict(plan.served), extractor, Public()),
        "encoding": encoding,
        "slots": slots,
        "start": start and start.digest,
        "earlier": [] if start is None else weights.legs(start.meta),
        "photographs": len(photographs_of(views)),
        "crops": training.steps * training.batch,
        "batch": training.batch,
        "optimizer": "muon",
        "symmetries": len(moved),
        "rate": training.rate,
        "seed": training.seed,
        "quantisation_error": errors,
    }
    if out.exists():
        done = weights.load(out).meta
        _same_training(out, done, meta)
        return done
    trainer = _Trainer(team, shape, training, out, meta, written)
    if start is not None and trainer.step == 0:
        read_as_descriptors = slots if defense.releases is WordSets and not one_by_one else 1
        trainer.start_from(start.module, read_as_descriptors)
    module = trainer.run(examples)
    if not team.leads:
        return meta
    meta["validation"] = validate(module, held_out, unseen[:VALIDATE_AT_MOST], slots, encoding)
    written.scalars({f"validation/{name}": value for name, value in meta["validation"].items()}, training.steps)
    written.close()
    weights.save(out, module, shape, meta)
    _checkpoint_path(out).unlink(missing_ok=True)
    return meta


def _same_training(path: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Refuse to go on with, or to overwrite, what another training left."""
    changed = [key for key in wanted if found.get(key) != wanted[key]]
    if changed:
        raise UserError(f"{path} is of another training (other {', '.join(changed)}); remove it, or name another --out")


def _examples(
    plan: Plan, views: Sequence[PhotographView], unseen: list[PhotographView]
) -> tuple[Examples, Examples, dict[str, float] | None]:
    """Training and validation examples, and the quantisation error on both where descriptors are quantised."""
    defense, served = plan.defense, plan.served
    if defense.dictionary_field is None:
        return Examples(views, defense, served, {}, Public()), Examples(unseen, defense, served, {}, Public()), None
    own = Asset(getattr(defense, defense.dictionary_field))
    plain = Public()
    chosen = fitting_dictionaries(photographs_of(views), [own, *plan.crossfit], plain)
    chosen_unseen = fitting_dictionaries(photographs_of(unseen), [own], plain)
    sizes = _sizes(defense, served)
    check_lengths({*chosen.values(), *chosen_unseen.values()}, sizes, plain)
    public = Public(remembered=0) if isinstance(views, OnDemand) else Public(quantise(views, chosen, sizes, plain), remembered=0)
    examples, held_out = Examples(views, defense, served, chosen, public), Examples(unseen, defense, served, chosen_unseen, plain)
    compared = views[:: 4 * math.ceil(len(views) / (4 * COMPARED))]  # as they are, at 256 pixels
    errors = {
        "training": quantisation_error(compared, chosen, public, sizes[0]),
        "validation": quantisation_error(unseen, chosen_unseen, plain, sizes[0]),
    }
    check_quantisation(errors["training"], errors["validation"])
    return examples, held_out, errors


def _sizes(defense: Defense, served: Served) -> list[int]:
    """How many words the dictionary may have in training, all (0) first and then the most."""
    if defense.word_count_field is None:
        return [0]
    setting = served.get(defense.word_count_field)
    sizes = [int(size) for size in setting.values] if isinstance(setting, OneOf) else [getattr(defense, defense.word_count_field)]
    return sorted(sizes, key=lambda size: (size > 0, -size))


def check_quantisation(training: float, validation: float) -> None:
    """Refuse a training set that the dictionary knows: an attacker who is trained on it makes the defense look safer than it is.

    Raises
    ------
    UserError
        if the quantisation error on the two sets of photographs differs by more than 5%.
    """
    if not abs(training - validation) <= TOLERANCE * validation:
        raise UserError(
            f"training photographs are {training:.4f} away from their words, unseen ones {validation:.4f}: more than "
            f"{TOLERANCE:.0%} apart, so the network would learn to trust words as it must not. Were the training photographs "
            "part of the dictionary? If not, give more photographs to --validation"
        )


def _stacked(defense: Defense, examples: Examples, view: PhotographView, encoding: Encoding) -> tuple[int, int]:
    """The most candidates a keypoint among the served settings (the greatest of each field), and the length of one."""
    most = {field: max(setting.values) for field, setting in examples.served.items() if isinstance(setting, OneOf)}
    fixed = {field: OneOf((value,)) for field, value in most.items()}
    largest = Examples(examples.views, defense, {**examples.served, **fixed}, examples.dictionaries, examples.public)
    _, slots, length = stack(largest.whole(view, np.random.default_rng(0)).release, encoding).shape
    return slots, length


def _checkpoint_path(out: Path) -> Path:
    return out.with_name(out.name + ".checkpoint")


class _Trainer(Learner[Inverter]):
    """A learner with its share of the batches, and the checkpoint that it is resumed from."""

    def __init__(self, team: Team, shape: Shape, training: Training, out: Path, meta: dict[str, Any], log: Log) -> None:
        torch.manual_seed(training.seed)
        super().__init__(Inverter(shape), training)
        self.team, self.meta, self.log = team, meta, log
        self.path = _checkpoint_path(out)
        if self.path.is_file():
            self._restore()

    def start_from(self, trained: Inverter, candidates: int) -> None:
        """Take over another network, and let the average begin there."""
        weights.start_from(self.module, trained, candidates)
        self.remember()

    def run(self, examples: Examples) -> Inverter:
        """Train to the end and return the network with averaged weights."""
        if self.step == self.training.steps:
            return self.averaged()
        with Progress("training", self.training.steps - self.step) as progress:
            started, before, smooth = time.monotonic(), self.step, math.nan
            shared = self.team.share(self.module)
            for points, photographs in self._batches(examples):
                loss = self._advance(shared, points, photographs)
                smooth = loss if math.isnan(smooth) else 0.98 * smooth + 0.02 * loss
                speed = (self.step - before) * self.training.batch / (time.monotonic() - started)
                self.log.scalars({"loss": loss, "rate": self.optimizer.rate, "images/s": speed}, self.step)
                progress.advance(1, f"loss {smooth:.4f}, {speed:.1f} images/s")
                if self.step % CHECKPOINT_EVERY == 0:
                    self._save()
        self._save()
        return self.averaged()

    def _batches(self, examples: Examples) -> Iterator[tuple[Points, Tensor]]:
        """This process's parts of the batches from the next step on, some being made while one is used."""
        training, places = self.training, self.team.part(self.training.batch)

        def make(step: int) -> tuple[Points, Tensor]:
            drawn = [examples.draw(np.random.default_rng([training.seed, step, place])) for place in places]
            return to_batch(drawn, self.meta["slots"], self.meta["encoding"])

        workers = max(1, (os.cpu_count() or 1) // self.team.size) if isinstance(examples.views, OnDemand) else 1
        with ThreadPoolExecutor(workers) as ahead:
            steps = iter(range(self.step, training.steps))
            coming = deque(ahead.submit(make, step) for step in itertools.islice(steps, workers))
            while coming:
                ready = coming.popleft().result()
                coming.extend(ahead.submit(make, step) for step in itertools.islice(steps, 1))
                yield ready

    def _advance(self, shared: nn.Module, points: Points, photographs: Tensor) -> float:
        """One step of the schedule. -> the loss of the whole batch"""
        warm = self.training.warmup
        value = self.team.mean(self.learn(points, photographs, (self.step - warm) / max(1, self.training.steps - warm), shared))
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss is {value} at step {self.step}")
        return value

    def _save(self) -> None:
        if not self.team.leads:
            return
        arrays = {f"weights/{name}": value.cpu().numpy() for name, value in self.module.state_dict().items()}
        arrays |= {f"average/{name}": value.cpu().numpy() for name, value in self.average.items()}
        arrays |= {f"moments/{name}": value.cpu().numpy() for name, value in self.optimizer.state().items()}
        tensor_file.save(self.path, CHECKPOINT, arrays, {**self.meta, "step": self.step})

    def _restore(self) -> None:
        arrays, meta, _ = tensor_file.load(self.path, CHECKPOINT)
        self.step = meta.pop("step")
        _same_training(self.path, meta, self.meta)
        kept: dict[str, dict[str, Tensor]] = {"weights": {}, "average": {}, "moments": {}}
        for name, array in arrays.items():
            kind, rest = name.split("/", 1)
            kept[kind][rest] = torch.from_numpy(array.copy())
        self.module.load_state_dict(kept["weights"])
        self.average = {name: value.to(self.device) for name, value in kept["average"].items()}
        self.optimizer.restore(kept["moments"])


def to_batch(examples: Sequence[Example], slots: int, encoding: Encoding) -> tuple[Points, Tensor]:
    """-> the encoded releases, (B, 3, 256, 256) photographs in [0, 1]"""
    points = encode([example.release for example in examples], [example.condition for example in examples], slots, encoding)
    pixels = torch.from_numpy(np.stack([example.pixels for example in examples]))
    return points, pixels.permute(0, 3, 1, 2).float() / 255


def validate(
    module: nn.Module, examples: Examples, views: Sequence[PhotographView], slots: int, encoding: Encoding
) -> dict[str, float]:
    """Mean MAE, SSIM (where its window fits) and PSNR over whole views, under settings drawn with a fixed seed."""
    device, rng = pick_device(), np.random.default_rng(0)
    scores = []
    for view in views:
        points, truth = to_batch([examples.whole(view, rng)], slots, encoding)
        scores.append(scored(paint(module, points.to(device)).cpu()[0], truth[0]))
    mae, similarity, psnr = np.mean(scores, axis=0)
    return {"photographs": len(views), "mae": float(mae), "ssim": float(similarity), "psnr": float(psnr)}


def scored(painted: Tensor, photograph: Tensor) -> tuple[float, float, float]:
    """MAE, SSIM (where its window fits) and PSNR of one image, (3, H, W) both."""
    error = painted - photograph
    return float(error.abs().mean()), float(ssim(painted, photograph)), -10 * math.log10(float(error.square().mean()))
