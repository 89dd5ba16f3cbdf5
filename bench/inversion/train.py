"""Training of an attacker's network for the releases of one or several defenses.

Each example is a function of (seed, step, index in the batch) alone. So a resumed training gives the same network, and several
processes can split a batch.
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

from bench.codebook.public import Public
from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.formats import tensor_file
from bench.images.views import LazyViews, PhotographView, collect_photograph_hashes, collect_views
from bench.inversion import weights
from bench.inversion.data import (
    Example,
    Examples,
    Target,
    assign_dictionaries,
    check_dictionary_sizes,
    measure_quantisation_error,
    quantise,
)
from bench.inversion.encoding import Encoded, EncodedRelease, Encoding, encode, encode_lines, stack
from bench.inversion.flow import FlowNetwork, add_noise, measure_loss, sample_images
from bench.inversion.kinds import AnyNetwork, build_network
from bench.inversion.learner import Learner
from bench.inversion.line_network import SAMPLES, LineInverter
from bench.inversion.log import Log
from bench.inversion.loss import ssim
from bench.inversion.network import Shape
from bench.inversion.plan import Drafts, Plan, Training
from bench.inversion.process_group import ProcessGroup, launch
from bench.inversion.reconstruct import infer, locate_keypoints
from bench.inversion.symmetry import IDENTITY, POSITION_SYMMETRIES, find_symmetries
from bench.registry.composed import configure
from bench.settings import Asset, Between, OneOf
from bench.types import Descriptors, Subspaces, WordSets

CHECKPOINT = "inversion-checkpoint"
CHECKPOINT_EVERY = 250  # steps
MAX_VALIDATED = 100  # photographs
VALIDATION_STEPS = 8  # of the solver, for a network that samples photographs
MAX_IN_MEMORY = 2000  # photographs, about 6 GB; with more photographs, views are computed on demand
VARIANCE_EXAMPLES = 64  # training examples by which the variance around drafts is measured
MAX_COMPARED = 1000  # training photographs for the comparison of quantisation errors
TOLERANCE = 0.05  # relative difference of the quantisation errors on training and on unseen photographs


def train(plan: Plan, out: Path, log: Path | None = None, devices: int = 1) -> dict[str, Any]:
    """Train a network, or resume its training, or load the finished network; return its metadata.

    Parameters
    ----------
    out : file of the weights; until the training ends, a checkpoint is stored beside it
    log : folder for TensorBoard: loss, rate and speed of each step, and the validation scores
    devices : number of devices that split each batch; the result is the same up to rounding

    Raises
    ------
    UserError
        if photographs are in both sets, or none is usable; if `out` or its checkpoint is of another training; if `log` is given
        and tensorboard is not installed; or if there are too few devices.
    """
    return launch(devices, plan.training.batch, train_worker, plan, out, log)


def train_worker(group: ProcessGroup, plan: Plan, out: Path, log: Path | None) -> dict[str, Any]:
    """Execute `train` in one process of the group."""
    writer = Log(log if group.is_main else None)
    targets, extractor, encoding, training = plan.targets, plan.extractor, plan.encoding, plan.training
    sets = _check_targets(targets, encoding)
    drafts = None if plan.drafts is None else find_drafts(targets, plan.drafts)
    shared = {source.content_hash() for source in plan.photographs} & {source.content_hash() for source in plan.validation}
    if shared:
        raise UserError(f"{len(shared)} photographs are in both the training and the validation set; remove them from one set")
    few = len(plan.photographs) <= MAX_IN_MEMORY
    source = plan.training_extractor
    views = collect_views(list(plan.photographs), source) if few else LazyViews(plan.photographs, source)
    unseen = collect_views(list(plan.validation), source)[::4]  # unmirrored, at 256 pixels
    examples, held_out, errors = _build_examples(plan, views, unseen)
    only_positions = encoding == "positions" and plan.drafts is None
    symmetries = POSITION_SYMMETRIES if only_positions else find_symmetries(extractor)
    examples = dataclasses.replace(examples, symmetries=symmetries)
    slots, length = _measure_stack(held_out, unseen[0], encoding)
    first = held_out.release_view(unseen[0], np.random.default_rng(0))
    samples = _count_samples(targets, encoding)
    if plan.model == "flow" and samples:
        raise UserError("--model flow: it reads points, and the defense hides positions; pass another --defense")
    sample, _ = build_batch([first], slots, encoding, samples)
    candidates = slots if encoding == "invariant" and sets else 0
    shape = Shape(inputs=sample.values.shape[1], candidates=candidates, length=length, widths=plan.widths, samples=samples)
    initial = None if plan.initial_checkpoint is None else weights.load(plan.initial_checkpoint)
    meta = {
        **weights.describe(targets, extractor, Public(), plan.keypoints),
        "encoding": encoding,
        "model": plan.model if plan.model != "inversion" else None,
        "drafts": drafts,
        "slots": slots,
        "start": initial and initial.digest,
        "earlier": [] if initial is None else weights.list_training_stages(initial.meta),
        "photographs": len(collect_photograph_hashes(views)),
        "crops": training.steps * training.batch,
        "batch": training.batch,
        "optimizer": "muon",
        "symmetries": len(symmetries),
        "rate": training.rate,
        "seed": training.seed,
        "quantisation_error": errors,
    }
    if out.exists():
        finished = weights.load(out).meta
        _check_same_training(out, finished, meta)
        return finished
    trainer = _Trainer(group, shape, training, out, meta, writer, plan.drafts)
    if trainer.step == 0:
        descriptor_slots = slots if sets and not candidates else 1
        trainer.initialise(views, None if initial is None else initial.module, descriptor_slots)
        if plan.drafts is not None:
            trainer.measure_variance(examples)
    module = trainer.run(examples)
    if not group.is_main:
        return meta
    meta["validation"] = validate(module, held_out, unseen[:MAX_VALIDATED], slots, encoding, plan.drafts)
    writer.add_scalars({f"validation/{name}": value for name, value in meta["validation"].items()}, training.steps)
    writer.close()
    weights.save(out, module, shape, meta)
    _checkpoint_path(out).unlink(missing_ok=True)
    return meta


def _check_same_training(path: Path, stored: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Raise UserError if a file is of another training."""
    changed = [key for key in expected if stored.get(key) != expected[key]]
    if changed:
        raise UserError(f"{path} is of another training (other {', '.join(changed)}); remove it, or pass another --out")


def _build_examples(
    plan: Plan, views: Sequence[PhotographView], unseen: list[PhotographView]
) -> tuple[Examples, Examples, dict[str, float] | None]:
    """Return training and validation examples, and the quantisation error on both if descriptors are quantised."""
    targets = plan.targets
    own = _find_dictionary(targets)
    if own is None:
        return Examples(views, targets, {}, Public()), Examples(unseen, targets, {}, Public()), None
    plain = Public()
    assigned = assign_dictionaries(collect_photograph_hashes(views), [own, *plan.crossfit], plain)
    assigned_unseen = assign_dictionaries(collect_photograph_hashes(unseen), [own], plain)
    sizes = _list_sizes(targets)
    check_dictionary_sizes({*assigned.values(), *assigned_unseen.values()}, sizes, plain)
    public = (
        Public(cache_size=0) if isinstance(views, LazyViews) else Public(quantise(views, assigned, sizes, plain), cache_size=0)
    )
    examples, held_out = (
        Examples(views, targets, assigned, public),
        Examples(unseen, targets, assigned_unseen, plain),
    )
    errors = {
        "training": measure_quantisation_error(select_views(views), assigned, public, sizes[0]),
        "validation": measure_quantisation_error(unseen, assigned_unseen, plain, sizes[0]),
    }
    check_quantisation(errors["training"], errors["validation"])
    return examples, held_out, errors


def select_views(views: Sequence[PhotographView]) -> Sequence[PhotographView]:
    """Return the unmirrored view at 256 pixels of at most `MAX_COMPARED` photographs."""
    return views[:: 4 * math.ceil(len(views) / (4 * MAX_COMPARED))]


def find_drafts(targets: Sequence[Target], drafts: Drafts) -> dict[str, str]:
    """Return the digest of the network that makes the drafts for each defense.

    Raises
    ------
    UserError
        if there is none for the least or greatest supported settings of a target, or there are several.
    """
    found: dict[str, set[str]] = {}
    for target in targets:
        limits = [
            (setting.low, setting.high) if isinstance(setting, Between) else setting.values
            for setting in target.supported_settings.values()
        ]
        for values in itertools.product(*limits):
            defense = configure(target.defense, dict(zip(target.supported_settings, values, strict=True)))
            found.setdefault(defense.name(), set()).add(drafts.digest(defense, Public()))
    several = [name for name, digests in found.items() if len(digests) > 1]
    if several:
        raise UserError(f"--drafts: several networks serve {', '.join(several)}; pass one network, or fewer settings")
    return {name: digests.pop() for name, digests in found.items()}


def _check_targets(targets: Sequence[Target], encoding: Encoding) -> bool:
    """Return whether any target releases word sets.

    Raises
    ------
    UserError
        if some, but not all, release subspaces, and the network reads more than positions.
    """
    releases = {target.defense.releases for target in targets}
    if Subspaces in releases and len(releases) > 1 and encoding != "positions":
        raise UserError(
            "--defense: a network for subspaces reads no other releases; train another network for the other defenses, or a "
            "network that reads positions and drafts alone (--model flow --encoding positions --drafts shipped)"
        )
    return WordSets in releases


def _count_samples(targets: Sequence[Target], encoding: Encoding) -> int:
    """Return the number of points on each line that the network reads; 0 if the targets release points.

    Raises
    ------
    UserError
        if only some targets release lines, or the encoding is not "invariant".
    """
    hidden = {target.defense.hides_positions() for target in targets}
    if len(hidden) > 1:
        raise UserError("--defense: a network for lines reads no points; train another network for the other defenses")
    if hidden == {True} and encoding != "invariant":
        raise UserError(f"--encoding {encoding}: a network for lines needs the encoding invariant")
    return SAMPLES if hidden == {True} else 0


def _find_dictionary(targets: Sequence[Target]) -> Asset | None:
    """Return the dictionary by which the targets quantise descriptors; None if none of them does.

    Raises
    ------
    UserError
        if they use several.
    """
    defenses = [target.defense for target in targets]
    used = {getattr(defense, defense.dictionary_field) for defense in defenses if defense.dictionary_field is not None}
    if len(used) > 1:
        raise UserError(f"--defense: one network needs one dictionary, got {', '.join(sorted(used))}")
    return Asset(used.pop()) if used else None


def _list_sizes(targets: Sequence[Target]) -> list[int]:
    """Return the sizes of the dictionary in training: 0, which stands for all words, first, then descending."""
    sizes: set[int] = set()
    for defense, supported in ((target.defense, target.supported_settings) for target in targets):
        if defense.dictionary_field is None:
            continue
        setting = OneOf((0,)) if defense.word_count_field is None else supported.get(defense.word_count_field)
        sizes |= (
            set(map(int, setting.values)) if isinstance(setting, OneOf) else {getattr(defense, str(defense.word_count_field))}
        )
    return sorted(sizes, key=lambda size: (size > 0, -size))


def check_quantisation(training: float, validation: float) -> None:
    """Check that the dictionary was not built from the training photographs, which would make the defense look safer than it is.

    Raises
    ------
    UserError
        if the quantisation error on the two sets of photographs differs by more than 5%.
    """
    if not abs(training - validation) <= TOLERANCE * validation:
        raise UserError(
            f"the quantisation error is {training:.4f} on training photographs and {validation:.4f} on unseen ones. They "
            f"differ by more than {TOLERANCE:.0%}, so the network would learn a wrong trust in words. Was the dictionary built "
            "from the training photographs? If not, pass more photographs to --validation"
        )


def _measure_stack(examples: Examples, view: PhotographView, encoding: Encoding) -> tuple[int, int]:
    """Return the maximum number of candidates per keypoint over the targets and their settings, and the length of one.

    Raises
    ------
    UserError
        if the targets release descriptors of several lengths, or only some release scales and orientations.
    """
    slots, lengths, frames = 0, set(), set()
    for target in examples.targets:
        most = {
            name: OneOf((max(given.values),)) for name, given in target.supported_settings.items() if isinstance(given, OneOf)
        }
        largest = dataclasses.replace(target, supported_settings={**target.supported_settings, **most})
        release = dataclasses.replace(examples, targets=[largest]).release_view(view, np.random.default_rng(0)).release
        _, used, length = stack(release, encoding).shape
        slots = max(slots, used)
        lengths.add(length)
        frames.add(isinstance(release, Descriptors) and release.frames is not None)
    if len(frames) > 1:
        raise UserError("--defense: some of them release scales and orientations, and others none; train a network for each kind")
    if len(lengths) > 1:
        raise UserError(f"--defense: one network reads descriptors of one length, got {sorted(lengths)}")
    return slots, lengths.pop()


def _checkpoint_path(out: Path) -> Path:
    return out.with_name(out.name + ".checkpoint")


class _Trainer(Learner[AnyNetwork]):
    """A learner with its part of each batch, and a checkpoint to resume from."""

    def __init__(
        self,
        group: ProcessGroup,
        shape: Shape,
        training: Training,
        out: Path,
        meta: dict[str, Any],
        log: Log,
        drafts: Drafts | None,
    ) -> None:
        torch.manual_seed(training.seed)
        super().__init__(build_network(shape, meta["model"]), training)
        self.group, self.meta, self.log, self.drafts = group, meta, log, drafts
        self.path = _checkpoint_path(out)
        if self.path.is_file():
            self._restore()

    def initialise(self, views: Sequence[PhotographView], trained: AnyNetwork | None, candidates: int) -> None:
        """Initialise weights and average, from another network if there is one."""
        if isinstance(self.module, FlowNetwork):
            self.module.measure_coefficients(view.pixels for view in select_views(views))
        if trained is not None:
            weights.initialise_from(self.module, trained, candidates)
        self.reset_average()

    def measure_variance(self, examples: Examples) -> None:
        """Fit the variance around drafts to some training examples."""
        assert isinstance(self.module, FlowNetwork)
        assert self.drafts is not None
        drawn = [examples.draw(np.random.default_rng([self.training.seed, number])) for number in range(VARIANCE_EXAMPLES)]
        slots, encoding = self.meta["slots"], self.meta["encoding"]
        points, photographs = build_batch(drawn, slots, encoding, drafts=self.drafts, public=examples.public)
        assert isinstance(points, EncodedRelease)
        assert points.drafts is not None
        self.module.measure_variance(points.drafts.to(self.device), photographs.to(self.device))
        self.reset_average()

    def run(self, examples: Examples) -> AnyNetwork:
        """Train to the end, and return the network with averaged weights."""
        if self.step == self.training.steps:
            return self.load_average()
        with Progress("training", self.training.steps - self.step) as progress:
            started, before, smooth = time.monotonic(), self.step, math.nan
            parallel = self.group.wrap(self.module)
            for points, photographs in self._batches(examples):
                loss = self._advance(parallel, points, photographs)
                smooth = loss if math.isnan(smooth) else 0.98 * smooth + 0.02 * loss
                speed = (self.step - before) * self.training.batch / (time.monotonic() - started)
                self.log.add_scalars({"loss": loss, "rate": self.optimizer.rate, "images/s": speed}, self.step)
                progress.advance(1, f"loss {smooth:.4f}, {speed:.1f} images/s")
                if self.step % CHECKPOINT_EVERY == 0:
                    self._save()
        self._save()
        return self.load_average()

    def _batches(self, examples: Examples) -> Iterator[tuple[Encoded, Tensor]]:
        """Yield this process's parts of the batches from the next step on. Threads build them in advance."""
        training, indices = self.training, self.group.assign_indices(self.training.batch)
        slots, encoding, samples = self.meta["slots"], self.meta["encoding"], self.module.shape.samples

        def build(step: int) -> tuple[Encoded, Tensor]:
            rngs = [np.random.default_rng([training.seed, step, index]) for index in indices]
            batch = [examples.draw(rng) for rng in rngs]
            points, photographs = build_batch(batch, slots, encoding, samples, self.drafts, examples.public)
            return (add_noise(points, photographs, rngs) if isinstance(self.module, FlowNetwork) else points), photographs

        workers = max(1, (os.cpu_count() or 1) // self.group.size) if isinstance(examples.views, LazyViews) else 1
        with ThreadPoolExecutor(workers) as executor:
            steps = iter(range(self.step, training.steps))
            pending = deque(executor.submit(build, step) for step in itertools.islice(steps, workers))
            while pending:
                batch = pending.popleft().result()
                pending.extend(executor.submit(build, step) for step in itertools.islice(steps, 1))
                yield batch

    def _advance(self, parallel: nn.Module, points: Encoded, photographs: Tensor) -> float:
        """Execute one step of the schedule. -> the loss of the whole batch"""
        warm = self.training.warmup
        progress = (self.step - warm) / max(1, self.training.steps - warm)
        value = self.group.average(self.learn(points, photographs, progress, parallel))
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss is {value} at step {self.step}")
        return value

    def _save(self) -> None:
        if not self.group.is_main:
            return
        arrays = {f"weights/{name}": value.cpu().numpy() for name, value in self.module.state_dict().items()}
        arrays |= {f"average/{name}": value.cpu().numpy() for name, value in self.average.items()}
        arrays |= {f"moments/{name}": value.cpu().numpy() for name, value in self.optimizer.state().items()}
        tensor_file.save(self.path, CHECKPOINT, arrays, {**self.meta, "step": self.step})

    def _restore(self) -> None:
        arrays, meta, _ = tensor_file.load(self.path, CHECKPOINT)
        self.step = meta.pop("step")
        _check_same_training(self.path, meta, self.meta)
        tensors: dict[str, dict[str, Tensor]] = {"weights": {}, "average": {}, "moments": {}}
        for name, array in arrays.items():
            kind, rest = name.split("/", 1)
            tensors[kind][rest] = torch.from_numpy(array.copy())
        self.module.load_state_dict(tensors["weights"])
        self.average = {name: value.to(self.device) for name, value in tensors["average"].items()}
        self.optimizer.restore(tensors["moments"])


def build_batch(
    examples: Sequence[Example],
    slots: int,
    encoding: Encoding,
    samples: int = 0,
    drafts: Drafts | None = None,
    public: Public | None = None,
) -> tuple[Encoded, Tensor]:
    """Encode examples of points, or of lines with `samples` each. -> the releases, (B, 3, 256, 256) photographs in [0, 1]

    `drafts` makes a draft of each photograph, by the dictionaries of `public`.
    """
    releases, settings = [example.release for example in examples], [example.settings for example in examples]
    points: Encoded
    if samples:
        points = encode_lines(releases, settings, slots, encoding, samples, [example.keypoints for example in examples])
    else:
        points = encode(releases, settings, slots, encoding)
    if drafts is not None:
        assert isinstance(points, EncodedRelease)  # only the model "flow" reads drafts, and it reads points
        assert public is not None
        images = np.stack([drafts(example.defense, example.release, public) for example in examples])
        points = dataclasses.replace(points, drafts=torch.from_numpy(images).permute(0, 3, 1, 2))
    pixels = torch.from_numpy(np.stack([example.pixels for example in examples]))
    return points, pixels.permute(0, 3, 1, 2).float() / 255


def validate(
    module: AnyNetwork,
    examples: Examples,
    views: Sequence[PhotographView],
    slots: int,
    encoding: Encoding,
    drafts: Drafts | None = None,
) -> dict[str, float]:
    """Return mean MAE, SSIM (where its window fits) and PSNR over whole views. Settings are drawn with a fixed seed.

    For lines also the mean over views of the median position error in pixels. A network that samples photographs draws one
    of each view, and `flow-loss` is its mean training loss.
    """
    device, rng = pick_device(), np.random.default_rng(0)
    scores, errors, losses = [], [], []
    for view in views:
        example = examples.release_view(view, rng)
        points, truth = build_batch([example], slots, encoding, module.shape.samples, drafts, examples.public)
        if isinstance(module, FlowNetwork) and isinstance(points, EncodedRelease):
            images = sample_images(module, points, 1, VALIDATION_STEPS, 1.0, rng)
            losses.append(measure_loss(module, add_noise(points, truth, [rng])))
        else:
            images = infer(module, points.to(device))
        scores.append(score(images.cpu()[0], truth[0]))
        if isinstance(module, LineInverter):
            located = locate_keypoints(module, example.release, [IDENTITY], example.settings, slots, encoding)
            errors.append(np.median(np.linalg.norm(located - example.keypoints, axis=1)))
    mae, similarity, psnr = np.mean(scores, axis=0)
    more = {name: float(np.mean(values)) for name, values in (("position-error", errors), ("flow-loss", losses)) if values}
    return {"photographs": len(views), "mae": float(mae), "ssim": float(similarity), "psnr": float(psnr)} | more


def score(reconstruction: Tensor, photograph: Tensor) -> tuple[float, float, float]:
    """Return MAE, SSIM (where its window fits) and PSNR of one image, (3, H, W) both."""
    error = reconstruction - photograph
    return float(error.abs().mean()), float(ssim(reconstruction, photograph)), -10 * math.log10(float(error.square().mean()))
