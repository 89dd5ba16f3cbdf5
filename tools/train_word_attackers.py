"""Trains the attackers of word sets: `context.safetensors` and `inversion-ldp.safetensors`.

    python tools/train_word_attackers.py --data DATA --work work/assets

DATA is the folder of `train/`, `tune.txt` and `test.txt`. The photographs are those of `make_assets.py`, in its three thirds.
Each third is quantised by a dictionary that was built from the other two: the last one by the shipped dictionary, the others by
two that this program builds. So no photograph is quantised by a dictionary built from it. There are three stages:

1. pairs: the context model learns log-ratios of true words (`bench.context.train.compute_pair_loss`),
2. releases: the context model learns the posterior of each candidate (`compute_loss`),
3. reconstructions: the inversion network learns to reconstruct from candidates and posteriors (`bench.context.reconstruct`). It
   starts from the shipped network for raw descriptors.

Releases are drawn under random settings: 70% from all words, 15% from the first half, and 15% from 32 times fewer words, which
are clustered from the others. For these, ε is smaller by ln 32, so that the chance of the true word is the same.

An interrupted training resumes from a checkpoint in the work folder, at most a minute old. The shipped networks took about 15
minutes of a GPU (H100). Features and dictionaries are computed before that, on the CPU. Without a GPU, use fewer steps.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as nnf
from make_assets import build_crossfit_dictionaries, split_photographs
from torch import Tensor, nn
from word_training_data import (
    Batch,
    TrainingData,
    assemble,
    collect_training_views,
    draw_crops,
    encode_batch,
    find_words,
    measure_errors,
    stack_views,
)

from bench.codebook.public import ASSETS, Public
from bench.context import weights as context_weights
from bench.context.encoding import prior_odds
from bench.context.network import ContextModel
from bench.context.network import Shape as ContextShape
from bench.context.reconstruct import reconstruct_from_posteriors
from bench.context.train import compute_loss, compute_pair_loss, validate
from bench.core.device import pick_device, pick_dtype
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.identification import thumbnails
from bench.images.photographs import SIDE, Source, list_photographs
from bench.images.views import PhotographView, collect_views
from bench.inversion import weights
from bench.inversion.data import Target, assign_dictionaries, measure_quantisation_error
from bench.inversion.loss import ssim
from bench.inversion.network import Inverter
from bench.inversion.optimizer import Optimizer
from bench.inversion.symmetry import IDENTITY
from bench.inversion.train import check_quantisation, score
from bench.settings import Asset, Between, OneOf
from defenses.ldp import LDP

CONTEXT_SHAPE = ContextShape(width=128, hidden=512, rank=40, neighbours=24, kernels=8)
SIZES = (1, 2, 3, 4)  # m
SEED = 0
PAIR_BATCH, BATCH = 24, 32  # crops; releases have a half or a quarter of the first
RATE = 3e-3  # at the peak; half of it for releases
DECAY = 0.01  # of the weights
WARMUP = 200  # steps
CONSTANT = 0.6  # fraction of the steps before the rate falls
ANCHORS = 6000  # keypoints of a batch whose pairs are used
CHECKPOINT = "word-attacker-checkpoint"
CHECKPOINT_SECONDS = 60.0
TARGETS = [  # those of `draw_releases`
    Target(defense=LDP(), supported_settings=LDP.supported_settings),
    Target(
        defense=LDP(dictionary=Asset("shipped-clustered")),
        supported_settings={**LDP.supported_settings, "epsilon": Between(4.6, 12.5), "words": OneOf((8000,))},
    ),
]
VALIDATED = [LDP(epsilon=epsilon, subset_size=size) for epsilon, size in ((8, 2), (10, 1), (10, 2), (10, 4), (12, 2), (16, 2))]
RECONSTRUCTED = [LDP(epsilon=epsilon) for epsilon in (8, 10, 12)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True, help="folder of dictionaries, checkpoints and finished files")
    parser.add_argument("--out", type=Path, default=ASSETS, help="folder of the two networks")
    parser.add_argument("--initial-checkpoint", type=Path, default=ASSETS / "inversion-none.safetensors")
    parser.add_argument(
        "--steps", type=int, nargs=3, default=(6300, 2261, 4400), metavar=("PAIRS", "RELEASES", "RECONSTRUCTIONS")
    )
    args = parser.parse_args()
    # Variances in SSIM are differences of nearly equal numbers. With products in TF32 they are wrong, and the training fails.
    torch.set_float32_matmul_precision("highest")
    folders = split_photographs(args.data, args.work / "photographs")
    crossfit = build_crossfit_dictionaries(folders, args.work)
    unseen = collect_views(list_photographs(folders["tune"]), Sift())[::4]  # unmirrored, at 256 pixels
    sources = list_photographs(folders["012"])
    data, meta = load_data(args.work / "word-training-data.pt", sources, unseen, crossfit, pick_device())
    context = train_context(args.work / "context.safetensors", data, unseen, meta, args.steps[0], args.steps[1])
    initial = weights.load(args.initial_checkpoint)
    inverter = train_inverter(args.work / "inversion-ldp.safetensors", data, unseen, meta, args.steps[2], context, initial)
    for file in (context.path, inverter):  # together: the second is bound to the digest of the first
        args.out.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, args.out / file.name)


# ---- data


def load_data(
    path: Path, sources: Sequence[Source], unseen: Sequence[PhotographView], crossfit: Sequence[Asset], device: torch.device
) -> tuple[TrainingData, dict[str, Any]]:
    """Build the training data, or load them from `path`; also return the metadata that describe them."""
    public = Public()
    candidates = [LDP().dictionary, *crossfit]
    inputs = [*sorted(source.content_hash() for source in sources), *map(public.digest, candidates)]
    digest = hashlib.sha256("".join(inputs).encode()).hexdigest()
    if path.is_file():
        stored = torch.load(path, map_location=device, weights_only=False)  # written by this program
        if stored["digest"] == digest:
            return stored["data"], stored["meta"]
    views = collect_training_views(sources)
    photographs = {view.photograph for view in views}
    assigned = assign_dictionaries(photographs, candidates, public)
    data = TrainingData(stack_views(views, device), find_words(views, assigned, public, device))
    own = {view.photograph: LDP().dictionary for view in unseen}
    validation, errors = measure_quantisation_error(unseen, own, public), measure_errors(data.views, data.words[0])
    for error in errors:  # of each third
        check_quantisation(error, validation)
    error_meta = {"training": float(np.mean(errors)), "validation": validation}
    meta = {"photographs": sorted(photographs), "quantisation_error": error_meta}
    unfinished = path.with_suffix(".unfinished")
    torch.save({"digest": digest, "data": data, "meta": meta}, unfinished)
    unfinished.replace(path)
    return data, meta


def draw_pairs(data: TrainingData, batch: int, neighbours: int, rng: np.random.Generator) -> Batch:
    """Draw crops whose sets hold the true word and a random one."""
    words = data.words[rng.choice(3, p=(0.75, 0.1, 0.15))]
    return assemble(data.views, words, draw_crops(data.views, batch, rng), np.full(batch, math.inf), 2, neighbours, rng)


def draw_releases(data: TrainingData, batch: Callable[[int], int], neighbours: int, rng: np.random.Generator) -> Batch:
    """Draw crops and releases of equally many words m per keypoint. `batch` gives the number of crops for m."""
    words = data.words[rng.choice(3, p=(0.7, 0.15, 0.15))]
    size = int(rng.choice(SIZES, p=(0.2, 0.55, 0.1, 0.15)))
    count = batch(size)
    epsilons = np.where(rng.random(count) < 0.8, rng.uniform(8, 12.5, count), rng.uniform(12.5, 16, count))
    if words is data.words[2]:
        epsilons += math.log(words.size / data.words[0].size)  # for the same chance of the true word
    return assemble(data.views, words, draw_crops(data.views, count, rng), epsilons, size, neighbours, rng)


# ---- training


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage of a training. The examples of a step are a function of (seed, number, step)."""

    name: str
    number: int
    steps: int
    rate: float
    average: float  # decay of the moving average of the weights
    loss: Callable[[Any, np.random.Generator], Tensor]  # of the network and the random numbers of a step
    warmup: int = WARMUP  # steps
    seed: int = SEED


def fit(module: nn.Module, stage: Stage, path: Path, inputs: str, interval: float = CHECKPOINT_SECONDS) -> None:
    """Train a network in place, and load its averaged weights.

    Parameters
    ----------
    path : checkpoint; an existing one is resumed
    inputs : digest of the data and of the initial weights
    interval : seconds between checkpoints

    Raises
    ------
    UserError
        if the checkpoint is of another training.
    FloatingPointError
        if a loss is not finite.
    """
    optimizer = Optimizer(module, stage.rate, DECAY)
    average = {name: value.clone() for name, value in module.state_dict().items()}
    meta = {"stage": stage.name, "steps": stage.steps, "rate": stage.rate, "seed": stage.seed, "inputs": inputs}
    done = restore(path, meta, module, average, optimizer) if path.is_file() else 0
    module.train()
    saved = time.monotonic()
    with Progress(stage.name, stage.steps - done) as progress:
        for step in range(done, stage.steps):
            optimizer.rate = stage.rate * compute_schedule(step, stage.steps, stage.warmup)
            rng = np.random.default_rng([stage.seed, stage.number, step])
            torch.manual_seed(int(rng.integers(2**62)))  # of permutations within a loss
            loss = stage.loss(module, rng)
            module.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
            optimizer.step()
            decay = min(stage.average, (step + 1) / (step + 10))  # small at first, while the weights change fast
            for name, weight in module.state_dict().items():
                if weight.is_floating_point():
                    average[name].lerp_(weight, 1 - decay)
            if step % 25 == 0 and not math.isfinite(float(loss.detach())):  # each look at a loss waits for the device
                raise FloatingPointError(f"{stage.name}: the loss is {float(loss.detach())} at step {step}")
            if step + 1 == stage.steps or time.monotonic() - saved >= interval:
                save(path, {**meta, "step": step + 1}, module, average, optimizer)
                saved = time.monotonic()
            progress.advance(1, f"loss {float(loss.detach()):.4f}" if step % 25 == 0 else "")
    module.load_state_dict(average)
    module.eval()


def compute_schedule(step: int, steps: int, warmup: int = WARMUP) -> float:
    """Return the fraction of the peak rate: a rise over the warm-up, then 1, then a linear fall to zero over the last 40%."""
    return min(1.0, (step + 1) / warmup) * min(1.0, (1 - step / steps) / (1 - CONSTANT))


def save(path: Path, meta: dict[str, Any], module: nn.Module, average: dict[str, Tensor], optimizer: Optimizer) -> None:
    """Write a checkpoint."""
    parts = {"weights": module.state_dict(), "average": average, "moments": optimizer.state()}
    arrays = {f"{part}/{name}": value.cpu().numpy() for part, values in parts.items() for name, value in values.items()}
    tensor_file.save(path, CHECKPOINT, arrays, meta)


def restore(path: Path, meta: dict[str, Any], module: nn.Module, average: dict[str, Tensor], optimizer: Optimizer) -> int:
    """Load a checkpoint into a network, its average and its optimizer. -> the number of finished steps"""
    arrays, stored, _ = tensor_file.load(path, CHECKPOINT)
    done = int(stored.pop("step"))
    if stored != meta:
        raise UserError(f"{path} is of another training; remove it, or pass another --work")
    parts: dict[str, dict[str, Tensor]] = {"weights": {}, "average": {}, "moments": {}}
    for name, array in arrays.items():
        part, rest = name.split("/", 1)
        parts[part][rest] = torch.from_numpy(array.copy())
    module.load_state_dict(parts["weights"])
    for name, value in parts["average"].items():
        average[name].copy_(value)
    optimizer.restore(parts["moments"])
    return done


# ---- the context model


def train_context(
    path: Path, data: TrainingData, unseen: Sequence[PhotographView], meta: dict[str, Any], pair_steps: int, steps: int
) -> context_weights.Network:
    """Train the context model in two stages and write it to `path`, unless that exists; return the network."""
    if path.is_file():
        return context_weights.load(path)
    torch.manual_seed(SEED)
    module = ContextModel(CONTEXT_SHAPE).to(data.views.codes.device)
    nn.init.normal_(module.query.weight, std=0.02)  # not zero, so that the keys learn from the first step on
    neighbours = CONTEXT_SHAPE.neighbours
    inputs = digest_inputs(meta)

    def pairs(module: ContextModel, rng: np.random.Generator) -> Tensor:
        return compute_pair_loss(module, draw_pairs(data, PAIR_BATCH, neighbours, rng).example, ANCHORS)

    def releases(module: ContextModel, rng: np.random.Generator) -> Tensor:
        drawn = draw_releases(data, lambda size: PAIR_BATCH // (2 if size < 3 else 4), neighbours, rng)
        return compute_loss(module, drawn.example, weight=0.3)

    secrets, public = [view.features for view in unseen], Public(cache_size=len(unseen))
    for stage in (
        Stage(name="pairs", number=0, steps=pair_steps, rate=RATE, average=0.998, loss=pairs),
        Stage(name="releases", number=1, steps=steps, rate=RATE / 2, average=0.998, loss=releases),
    ):
        fit(module, stage, path.with_name(f"{stage.name}.checkpoint"), inputs)
        rows = [
            {"epsilon": defense.epsilon, "subset_size": defense.subset_size, **validate(module, secrets, defense, public)}
            for defense in VALIDATED
        ]
        print_rows(stage.name, rows)
    described = {
        **weights.describe(TARGETS, Sift(), Public()),
        **meta,
        "crops": round(PAIR_BATCH * (pair_steps + 7 / 16 * steps)),  # of releases: a half for 3/4 of the steps, else a quarter
        "batch": PAIR_BATCH,
        "rate": RATE,
        "seed": SEED,
        "validation": rows,
    }
    context_weights.save(path, module, described)
    return context_weights.load(path)


def digest_inputs(meta: dict[str, Any], *others: str) -> str:
    """Return a digest of the training photographs and of further inputs."""
    return hashlib.sha256("".join([*meta["photographs"], *others]).encode()).hexdigest()


def print_rows(title: str, rows: Sequence[dict[str, float]]) -> None:
    """Print the scores on the photographs for tuning."""
    print(f"{title}, on the photographs for tuning")
    for row in rows:
        print("  " + ", ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)


# ---- the inversion network


def train_inverter(
    path: Path,
    data: TrainingData,
    unseen: Sequence[PhotographView],
    meta: dict[str, Any],
    steps: int,
    context: context_weights.Network,
    initial: weights.Network,
) -> Path:
    """Train the inversion network on candidates with posteriors and write it to `path`, unless that exists; return the path."""
    if path.is_file():
        return path
    device = data.views.codes.device
    dtype = pick_dtype(device)
    torch.manual_seed(SEED)
    raw = initial.module
    assert isinstance(raw, Inverter)
    module: Inverter = build_inverter(raw).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]

    def reconstructions(module: Inverter, rng: np.random.Generator) -> Tensor:
        drawn = draw_releases(data, lambda size: BATCH, context.module.shape.neighbours, rng)
        with torch.no_grad():
            logs = context.module(drawn.example.graph).logits.log_softmax(dim=1)
        with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
            images = module(encode_batch(drawn, logs))
        return compute_reconstruction_loss(images.float(), drawn.photographs)

    stage = Stage(name="reconstructions", number=2, steps=steps, rate=RATE, average=0.999, loss=reconstructions)
    inputs = digest_inputs(meta, context.digest, initial.digest)
    fit(module, stage, path.with_name(f"{stage.name}.checkpoint"), inputs)
    public = Public(cache_size=len(unseen))
    rows = [
        {"epsilon": defense.epsilon, **validate_reconstructions(module, context.module, unseen, defense, public)}
        for defense in RECONSTRUCTED
    ]
    print_rows(stage.name, rows)
    described = {
        **weights.describe(TARGETS, Sift(), Public()),
        **meta,
        "photographs": len(meta["photographs"]),
        "encoding": "posteriors",
        "context": context.digest,
        "slots": module.shape.candidates,
        "start": initial.digest,
        "earlier": weights.list_training_stages(initial.meta),
        "crops": BATCH * steps,
        "batch": BATCH,
        "optimizer": "muon",
        "symmetries": 8,
        "rate": RATE,
        "seed": SEED,
        "validation": rows,
    }
    weights.save(path, module, module.shape, described)
    return path


def build_inverter(trained: Inverter) -> Inverter:
    """Build a network for candidates with posteriors, initialised from one for raw descriptors.

    It embeds a candidate as the other network embeds a descriptor. At first, posteriors alone weigh the candidates.
    """
    most, length = max(SIZES), trained.shape.length
    inputs = most * length + 2 + most + 1 + 2  # candidates, position, log posteriors, defense
    module = Inverter(dataclasses.replace(trained.shape, inputs=inputs, candidates=most, posteriors=True))
    for layer in (module.weigh[2], module.alone[2]):
        for parameter in layer.parameters():
            nn.init.zeros_(parameter)
    missing, unexpected = module.load_state_dict(trained.state_dict(), strict=False)
    if unexpected or any(not name.startswith(("weigh.", "alone.")) for name in missing):
        raise UserError("--initial-checkpoint: not a network for raw descriptors")
    return module


def compute_reconstruction_loss(images: Tensor, photographs: Tensor) -> Tensor:
    """Return 0.6 L1 + 0.04 log MSE + 0.3 (1 - SSIM) + 0.06 contrastive loss of thumbnails. (B, 3, H, W) twice -> ()

    SSIM is that of the three channels. The logarithm gives easy and hard images equal weight.
    """
    absolute = (images - photographs).abs().mean()
    logarithm = ((images - photographs).square().mean(dim=(1, 2, 3)) + 1e-5).log().mean()
    similarity = ssim(images.flatten(0, 1), photographs.flatten(0, 1))
    return 0.6 * absolute + 0.04 * logarithm + 0.3 * (1 - similarity) + 0.06 * compute_contrast(images, photographs)


def compute_contrast(images: Tensor, photographs: Tensor) -> Tensor:
    """Return the cross-entropy of the right photograph in the batch, by thumbnails at temperature 0.1, and vice versa. -> ()"""
    similarities = compute_thumbnails(images) @ compute_thumbnails(photographs).T / 0.1  # (B, B)
    target = torch.arange(len(images), device=images.device)
    return 0.5 * (nnf.cross_entropy(similarities, target) + nnf.cross_entropy(similarities.T, target))


def compute_thumbnails(images: Tensor) -> Tensor:
    """Return normalised thumbnails as in the metric `identified`, except at the border. (B, 3, 256, 256) -> (B, 256)"""
    weights = build_thumbnail_weights(images.device)
    luminance = (images * torch.tensor(thumbnails.LUMINANCE, device=images.device).view(3, 1, 1)).sum(dim=1)
    small = (weights @ luminance @ weights.T).flatten(1)
    return nnf.normalize(small - small.mean(dim=1, keepdim=True), eps=thumbnails.CONSTANT * thumbnails.SIDE)


@functools.cache
def build_thumbnail_weights(device: torch.device) -> Tensor:
    """Return the weights of a blur and an average over 16 intervals. -> (16, 256)"""
    pixels = torch.arange(SIDE, dtype=torch.float64)
    blur = torch.exp(-((pixels[:, None] - pixels) ** 2) / (2 * thumbnails.SIGMA**2))
    blur /= blur.sum(dim=1, keepdim=True)
    return blur.unflatten(0, (thumbnails.SIDE, -1)).mean(dim=1).float().to(device)


def validate_reconstructions(
    module: Inverter, context: ContextModel, views: Sequence[PhotographView], defense: LDP, public: Public
) -> dict[str, float]:
    """Return mean SSIM and PSNR, and the fraction of photographs that have the most similar thumbnail of all."""
    images, truths, scores = [], [], []
    for number, view in enumerate(views):
        release = defense.protect(view.features, public, np.random.default_rng([SEED, number]))
        odds = prior_odds(defense, public, release.subset_size)
        image = torch.from_numpy(reconstruct_from_posteriors(module, context, release, odds, [IDENTITY]).transpose(2, 0, 1))
        truth = torch.from_numpy(view.pixels).permute(2, 0, 1).float() / 255
        images.append(image)
        truths.append(truth)
        scores.append(score(image, truth))
    similarities = compute_thumbnails(torch.stack(images)) @ compute_thumbnails(torch.stack(truths)).T
    identified = (similarities.argmax(dim=1) == torch.arange(len(views))).float().mean()
    _, similarity, psnr = np.mean(scores, axis=0)
    return {"ssim": float(similarity), "psnr": float(psnr), "identified": float(identified)}


if __name__ == "__main__":
    main()
