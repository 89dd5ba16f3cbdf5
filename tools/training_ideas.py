"""Compares ideas for the inversion network in short trainings of equal processor time, and ranks them on `tune.txt`.

    python tools/training_ideas.py --data ../shared/data [--idea NAME ...] [--seconds 240] [--initial-checkpoint FILE]

IDEAS lists how each idea differs from `bench train`. All train on raw descriptors of the photographs of `train/` that are in
neither list, from random weights or from a trained network, and are scored on the 100 of `tune.txt`. Each training appends a line
to docs/results/training-ideas.jsonl, from which the tool without options writes docs/results/training-ideas.md. Without --idea,
the ideas that the log lacks for this time and checkpoint are trained, so an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as nnf
from make_assets import split_photographs
from perceptual_loss import extract_classifier, extract_vgg, measure_dissimilarity, vgg_file
from result_page import RESULTS, write_page
from torch import Tensor, nn

from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.images.photographs import list_photographs
from bench.images.views import PhotographView, collect_views
from bench.inversion import weights
from bench.inversion.data import Example, Examples, Target
from bench.inversion.encoding import CELL, Encoded, EncodedRelease
from bench.inversion.learner import Learner
from bench.inversion.loss import LUMA, WEIGHT, ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Training
from bench.inversion.reconstruct import reconstruct_image
from bench.inversion.symmetry import IDENTITY, Symmetry, find_symmetries
from bench.inversion.train import build_batch, score, validate
from bench.types import Descriptors, Points
from defenses.none import Undefended

LOG = RESULTS / "training-ideas.jsonl"
SIZES = ("samples", "parameters", "photographs", "date")
WARMUP = 50  # steps; fewer than in `bench train`, since these trainings are short
UNCHANGED = "as bench train"
PAPER = {"ssim": (0.6878, 3), "psnr": (18.59, 2)}  # the row of raw descriptors, and digits
VGG = "loss: VGG features"
UNTURNED = "not rotated"  # but mirrored, as half of the views are
INPUTS = 128 + 2  # a raw descriptor, and the position within a cell


# ---- losses


def compute_loss(
    reconstruction: Tensor,
    photograph: Tensor,
    dissimilarity: float = WEIGHT,
    l1: float = 1.0,
    rmse: float = 0.0,
    psnr: float = 0.0,
    coarse: float = 0.0,
    gradient: float = 0.0,
    classifier: float = 0.0,
    vgg: float = 0.0,
) -> Tensor:
    """Return a weighted sum of losses: 1 - SSIM of luminance, L1, root and logarithm of each image's square error, L1 of four
    coarser scales, of differences between neighbouring pixels, and of features of a classifier or VGG.

    The default is the loss of `bench train`.
    """
    luma = torch.tensor(LUMA, device=reconstruction.device).view(1, 3, 1, 1)
    total = dissimilarity * (1 - ssim((reconstruction * luma).sum(dim=1), (photograph * luma).sum(dim=1)))
    total = total + l1 * (reconstruction - photograph).abs().mean()
    if rmse or psnr:
        mse = (reconstruction - photograph).square().mean(dim=(1, 2, 3)) + 1e-4
        total = total + rmse * mse.sqrt().mean() + psnr * mse.log().mean()
    if gradient:
        error = reconstruction - photograph
        total = total + gradient * sum(error.diff(dim=axis).abs().mean() for axis in (2, 3))
    if coarse:
        for _ in range(4):
            reconstruction, photograph = nnf.avg_pool2d(reconstruction, 2), nnf.avg_pool2d(photograph, 2)
            total = total + coarse * (reconstruction - photograph).abs().mean()
    for weight, extract in ((classifier, extract_classifier), (vgg, extract_vgg)):
        if weight:
            total = total + weight * measure_dissimilarity(reconstruction, photograph, extract)
    return total


# ---- networks


class Attentive(Inverter):
    """Keypoints attend to their nearest neighbours before they are scattered."""

    def __init__(self, shape: Shape, blocks: int) -> None:
        super().__init__(shape)
        self.blocks = nn.ModuleList(Neighbours(shape.hidden) for _ in range(blocks))

    def embed_points(self, points: EncodedRelease) -> Tensor:
        hidden = super().embed_points(points)
        near, apart = find_nearest(points.image, points.coordinates * CELL, Neighbours.count)
        for block in self.blocks:
            hidden = block(hidden, near, apart)
        return hidden


class Neighbours(nn.Module):
    """Attention of each keypoint to its nearest neighbours, by embedding and relative position; then an MLP."""

    count = 12
    heads, width = 4, 24

    def __init__(self, hidden: int) -> None:
        super().__init__()
        inner = self.heads * self.width
        self.norm = nn.LayerNorm(hidden)
        self.query, self.key_value = nn.Linear(hidden, inner), nn.Linear(hidden, 2 * inner)
        self.where = nn.Sequential(nn.Linear(6, 32), nn.SiLU(), nn.Linear(32, self.heads + inner))
        self.out = nn.Linear(inner, hidden)
        last = nn.Linear(hidden, hidden)
        self.own = nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.SiLU(), last)
        nn.init.zeros_(self.out.weight)  # a block starts as the identity
        nn.init.zeros_(last.weight)

    def forward(self, hidden: Tensor, near: Tensor, apart: Tensor) -> Tensor:
        """(P, hidden), (P, k) neighbours, (P, k, 6) relative positions -> (P, hidden)"""
        count, inner = near.shape[1], self.heads * self.width
        normed = self.norm(hidden)
        query = self.query(normed).view(-1, 1, self.heads, self.width)
        key, value = self.key_value(normed)[near].split(inner, dim=2)
        bias, moved = self.where(apart).split([self.heads, inner], dim=2)
        weight = (query * key.view(-1, count, self.heads, self.width)).sum(dim=3) / self.width**0.5 + bias
        value = (value + moved).view(-1, count, self.heads, self.width)
        gathered = (weight.softmax(dim=1)[..., None] * value).sum(dim=1)
        hidden = hidden + self.out(gathered.reshape(-1, inner))
        return hidden + self.own(hidden)


@torch.no_grad()
def find_nearest(image: Tensor, positions: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the nearest keypoints of the same image, (P, k), and offset, direction and distance to each, (P, k, 6)."""
    neighbours, start = [], 0
    for many in torch.bincount(image).tolist():
        own = positions[start : start + many]
        near = torch.cdist(own, own).topk(min(count, many), largest=False).indices
        neighbours.append(nnf.pad(near, (0, count - near.shape[1]), mode="replicate") + start)
        start += many
    near = torch.cat(neighbours)
    offset = (positions[near] - positions[:, None]) / 16
    distance = offset.norm(dim=2, keepdim=True)
    shapes = [offset.clamp(-4, 4) / 2, offset / (distance + 1e-3), torch.log1p(distance), torch.exp(-distance)]
    return near, torch.cat(shapes, dim=2)


# ---- more photographs from fewer


def zoom(example: Example, min_fraction: float, rng: np.random.Generator) -> Example:
    """Enlarge a random square of the crop, with at least `min_fraction` of its side, to the size of the crop.

    A descriptor has the scale of its keypoint, so it stays nearly the same.
    """
    side = len(example.pixels)
    window = int(rng.integers(round(min_fraction * side), side + 1))
    left, top = rng.integers(side - window + 1, size=2)
    moved = (example.release.keypoints - np.array([left, top], dtype=np.float32)) * np.float32(side / window)
    inside = np.all((moved >= 0) & (moved < side), axis=1)
    if not inside.any():
        return example
    cropped = example.pixels[top : top + window, left : left + window]
    pixels = np.asarray(cv2.resize(cropped, (side, side), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    assert isinstance(example.release, Descriptors)
    release = dataclasses.replace(
        example.release, positions=Points(keypoints=moved[inside]), descriptors=example.release.descriptors[inside], frames=None
    )
    return dataclasses.replace(example, pixels=pixels, release=release)


def relight(example: Example, limit: float, rng: np.random.Generator) -> Example:
    """Change brightness and contrast at random, up to `limit`. Descriptors of normalised gradients stay the same."""
    contrast, brightness = 1 + rng.uniform(-limit, limit), rng.uniform(-limit, limit)
    pixels = np.clip((example.pixels / 255 - 0.5) * contrast + 0.5 + brightness, 0, 1)
    return dataclasses.replace(example, pixels=np.round(255 * pixels).astype(np.uint8))


def drop_keypoints(points: Encoded, fraction: float, rng: np.random.Generator) -> Encoded:
    """Drop a fraction of the keypoints at random."""
    mask = torch.from_numpy(rng.random(len(points.image)) >= fraction)
    return dataclasses.replace(points, **{name: getattr(points, name)[mask] for name in ("values", "coordinates", "image")})


# ---- schedules


def create_linear_decay(last: float) -> Callable[[float], float]:
    """Return a schedule with a linear decay to zero in the last fraction of the training."""
    return lambda progress: math.acos(2 * min(1.0, (1 - progress) / last) - 1) / math.pi  # where the cosine has that rate


# ---- ideas


@dataclass(frozen=True, kw_only=True)
class Idea:
    """The differences from `bench train`."""

    shape: dict[str, Any] = field(default_factory=dict)
    attention: int = 0  # blocks
    loss_weights: dict[str, float] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    photographs: int = 800
    dropped: float = 0.0  # fraction of keypoints
    min_zoom: float = 1.0  # least fraction of a crop's side
    lighting: float = 0.0  # maximum change of brightness and contrast, as a fraction of the range
    upright: bool = True
    turned: bool = True
    schedule: Callable[[float], float] = float  # fraction of the training -> position on the cosine

    def build_network(self) -> Inverter:
        shape = Shape(**{"inputs": INPUTS} | self.shape)
        return Attentive(shape, self.attention) if self.attention else Inverter(shape)

    def compute_loss(self, reconstruction: Tensor, photograph: Tensor) -> Tensor:
        return compute_loss(reconstruction, photograph, **self.loss_weights)

    def draw(self, examples: Examples, rng: np.random.Generator) -> Example:
        example = examples.draw(rng)
        example = zoom(example, self.min_zoom, rng) if self.min_zoom < 1 else example
        return relight(example, self.lighting, rng) if self.lighting else example


IDEAS = {
    UNCHANGED: Idea(),
    "loss: rmse for l1": Idea(loss_weights={"l1": 0.0, "rmse": 1.0}),
    "loss: psnr beside l1": Idea(loss_weights={"psnr": 0.05}),
    "loss: coarser scales": Idea(loss_weights={"coarse": 0.25}),
    "loss: gradients": Idea(loss_weights={"gradient": 0.5}),
    "loss: more ssim": Idea(loss_weights={"dissimilarity": 0.6}),
    "loss: psnr for l1": Idea(loss_weights={"l1": 0.0, "psnr": 0.05}),
    "loss: classifier features": Idea(loss_weights={"classifier": 0.1}),
    VGG: Idea(loss_weights={"vgg": 0.1}),
    "linear decay of the rate": Idea(schedule=create_linear_decay(1.0)),
    "linear decay in the last 30%": Idea(schedule=create_linear_decay(0.3)),
    "rate 8e-3": Idea(training={"rate": 8e-3}),
    "rate 2e-3": Idea(training={"rate": 2e-3}),
    "batches of 4": Idea(training={"batch": 4}),
    "batches of 16": Idea(training={"batch": 16}),
    "shorter average of the weights": Idea(training={"average": 0.99}),
    "half the channels": Idea(shape={"widths": (16, 32, 56, 56)}),
    "1.5 times the channels": Idea(shape={"widths": (48, 96, 168, 168)}),
    "twice the channels, 320 hidden": Idea(shape={"widths": (64, 128, 224, 224), "hidden": 320}),
    "twice the channels at the bottom": Idea(shape={"widths": (32, 64, 128, 224)}),
    "one more level": Idea(shape={"widths": (32, 64, 112, 112, 112)}),
    "192 hidden": Idea(shape={"hidden": 192}),
    "320 hidden": Idea(shape={"hidden": 320}),
    "512 hidden": Idea(shape={"hidden": 512}),
    "patches of 10": Idea(shape={"patch": 10}),
    "patches of 2": Idea(shape={"patch": 2}),
    "keypoint dropout": Idea(dropped=0.2),
    "zoomed": Idea(min_zoom=0.7),
    "brightness and contrast": Idea(lighting=0.1),
    "attention": Idea(attention=2),
    f"{UNCHANGED}; 200 photographs": Idea(photographs=200),
    f"{UNCHANGED}; 400 photographs": Idea(photographs=400),
    UNTURNED: Idea(turned=False),
    f"{UNTURNED}; 200 photographs": Idea(turned=False, photographs=200),
    f"{UNTURNED}; 400 photographs": Idea(turned=False, photographs=400),
    "oriented": Idea(upright=False),
    "oriented: attention": Idea(upright=False, attention=2),
}


# ---- training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="the folder of tune.txt and train/; without it, only the page is written")
    parser.add_argument("--work", type=Path, default=Path("work/ideas"), help="folder of features, reused (default: %(default)s)")
    parser.add_argument("--idea", choices=IDEAS, action="append", help="train this idea, also if the log has it; may be repeated")
    parser.add_argument("--seconds", type=float, default=240, help="processor time per idea, over all threads")
    parser.add_argument("--initial-checkpoint", type=Path, help="a network for raw descriptors, instead of random weights")
    args = parser.parse_args()
    records = [json.loads(line) for line in LOG.read_text(encoding="utf-8").splitlines()]
    initial = args.initial_checkpoint and args.initial_checkpoint.stem
    logged = {(record["idea"], record["seconds"], record.get("initial_checkpoint")) for record in records}
    available = [name for name in IDEAS if name != VGG or vgg_file().is_file()]
    names = args.idea or [name for name in available if (name, args.seconds, initial) not in logged]
    for name in names if args.data else ():
        try:
            records.append({"idea": name, "date": time.strftime("%Y-%m-%d"), **try_idea(IDEAS[name], args)})
        except UserError as error:
            parser.error(str(error))
        print(records[-1], flush=True)
        with LOG.open("a", encoding="utf-8") as log:
            log.write(json.dumps(records[-1]) + "\n")
    write_page("training-ideas.md", format_page(records), records)


def try_idea(idea: Idea, args: argparse.Namespace) -> dict[str, Any]:
    """Train for the given time, and score the averaged weights."""
    photographs, tune = (load_views(args, which, idea.upright) for which in ("012", "tune"))
    symmetries = find_symmetries(Sift(upright=idea.upright))
    under = symmetries if idea.turned else (IDENTITY,)
    examples = Examples(
        photographs[: 4 * idea.photographs], [Target(defense=Undefended(), supported_settings={})], {}, Public(), under
    )
    unseen = Examples(tune, [Target(defense=Undefended(), supported_settings={})], {}, Public())
    torch.manual_seed(0)
    network, training, initial = idea.build_network(), {"warmup": WARMUP, **idea.training}, {}
    if args.initial_checkpoint:
        checkpoint = weights.load(args.initial_checkpoint)
        network.load_state_dict(checkpoint.module.state_dict())
        training = {"rate": 1e-3, **training}  # as in the second stage of tools/make_assets.py
        initial = {"initial_checkpoint": args.initial_checkpoint.stem, "initial_digest": checkpoint.digest}
    learner = Learner(network, Training(**training), idea.compute_loss)
    samples = fit(learner, examples, idea, args.seconds)
    network = learner.load_average()
    scores = validate(network, unseen, tune[::4], 1, "invariant")
    averaged = score_average(network, symmetries, tune[::4])
    parameters = sum(weight.numel() for weight in network.parameters())
    return {
        "upright": idea.upright,
        "seconds": args.seconds,
        **initial,
        "photographs": idea.photographs,
        "samples": samples,
        "parameters": parameters,
        **{metric: scores[metric] for metric in ("mae", "ssim", "psnr")},
        "averaged": averaged,
    }


def fit(learner: Learner[Inverter], examples: Examples, idea: Idea, seconds: float) -> int:
    """Train for the given time. -> number of training samples"""
    started, reported = time.process_time(), 0
    with Progress("training", round(seconds)) as progress:
        while (fraction := (time.process_time() - started) / seconds) < 1:
            rng = np.random.default_rng([0, learner.step])
            points, photographs = build_batch([idea.draw(examples, rng) for _ in range(learner.training.batch)], 1, "invariant")
            points = drop_keypoints(points, idea.dropped, rng) if idea.dropped else points
            value = float(learner.learn(points, photographs, idea.schedule(fraction)))
            progress.advance(int(seconds * fraction) - reported, f"loss {value:.4f}, {learner.step} steps")
            reported = int(seconds * fraction)
    return learner.step * learner.training.batch


def score_average(network: Inverter, symmetries: Sequence[Symmetry], views: Sequence[PhotographView]) -> dict[str, float]:
    """Return mean SSIM and PSNR of reconstructions averaged over symmetries, as in `dia`."""
    scores = []
    for view in views:
        raw = view.features
        release = Descriptors(positions=Points(keypoints=raw.keypoints), size=raw.size, descriptors=raw.descriptors)
        image = reconstruct_image(network, release, symmetries, np.empty(0, np.float32), 1, "invariant")
        scores.append(score(*(torch.from_numpy(pixels).permute(2, 0, 1) for pixels in (image, view.pixels / np.float32(255)))))
    _, similarity, psnr = np.mean(scores, axis=0)
    return {"times": len(symmetries), "ssim": float(similarity), "psnr": float(psnr)}


def load_views(args: argparse.Namespace, which: str, upright: bool) -> list[PhotographView]:
    """Load all views of a set of photographs; they are extracted once."""
    cache = args.work / f"{which}-{'upright' if upright else 'oriented'}.pickle"
    if not cache.is_file():
        args.work.mkdir(parents=True, exist_ok=True)
        folders = split_photographs(args.data, args.work / "photographs")
        cache.write_bytes(pickle.dumps(collect_views(list_photographs(folders[which]), Sift(upright=upright))))
    views: list[PhotographView] = pickle.loads(cache.read_bytes())
    return views


def format_page(records: Sequence[dict[str, Any]]) -> str:
    """Return the page: trainings grouped by their time, the best first."""
    lines = [
        "# Ideas for the inversion network",
        "",
        "`tools/training_ideas.py` defines each idea. [The log](training-ideas.jsonl) has one line for each training, which "
        "`--data DATA --idea NAME --seconds SECONDS --initial-checkpoint FILE` appends.",
        "",
        "The networks invert raw descriptors. Trainings in one table had equal processor time. They started from random weights, "
        "unless the table names an initial checkpoint. Scores are of the 100 photographs of `tune.txt` (SSIM where its window "
        "fits). Short trainings favour fast learners, and each was run once: ignore small differences.",
        "",
        "- *averaged*: scores of the mean over reconstructions from mirrored and rotated releases, with their number.",
        "- *earlier*: another layout or optimizer, from the history of this repository. Muon without two layers is described by "
        "its name.",
        "- Trainings of more than 10 minutes are by `bench train`, with the wall time of its threads. The shipped networks were "
        "trained in stages, each from the result of the previous one.",
    ]
    for group in sorted({describe_group(record) for record in records}):
        oriented, seconds, initial = group
        members = [record for record in records if describe_group(record) == group]
        kind, origin = "Oriented" if oriented else "Upright", f", from `{initial}`" if initial else ""
        lines += ["", f"## {kind} SIFT, {seconds / 60:g} minutes of one core{origin}", ""]
        lines += [markdown_row(("idea", "MAE", "SSIM, PSNR", "averaged", *SIZES)), markdown_row(["---"] * 8)]
        for record in sorted(members, key=lambda record: -record["ssim"]):
            averaged = record["averaged"]
            scores = [f"{record['mae']:.4f}", f"{record['ssim']:.4f}, {record['psnr']:.2f}"]
            scores += [f"{averaged['ssim']:.4f}, {averaged['psnr']:.2f} ({averaged['times']})"]
            sizes = f"{record['samples']:,}", f"{record['parameters'] / 1e6:.1f} M"
            lines.append(markdown_row((record["idea"], *scores, *sizes, record["photographs"], record["date"])))
    alone = [record for record in records if record["upright"] and not record.get("initial_checkpoint")]
    lines += ["", "## Extrapolation to the paper's scores", ""]
    lines += ["One reconstruction; upright, from random weights, unless stated otherwise."]
    for idea in (UNCHANGED, UNTURNED):
        whole = [record for record in alone if record["idea"] == idea]
        fewer = [record for record in alone if record["idea"] in (f"{idea}; 200 photographs", f"{idea}; 400 photographs")]
        longest = max((record["seconds"] for record in fewer), default=0)
        same = [record for record in whole if record["seconds"] == longest]
        lines += extrapolate(f"{idea.capitalize()}, by training samples", whole, "samples")
        lines += extrapolate(f"{idea.capitalize()}, by photographs, in {longest / 60:g} minutes", fewer + same, "photographs")
    for upright, first in ((True, UNTURNED), (False, f"{UNTURNED}; oriented")):
        same = [record for record in records if record["upright"] == upright]
        stages = [record for record in same if record["idea"] == first and not record.get("initial_checkpoint")]
        # `before`: training samples of the initial checkpoint, in rows of `bench train`, which are added by hand.
        stages += [record | {"samples": record["before"] + record["samples"]} for record in same if "before" in record]
        kind = "upright" if upright else "oriented"
        lines += extrapolate(f"By samples of all stages, {kind}, the first stage without rotations", stages, "samples")
    return "\n".join(lines)


def describe_group(record: dict[str, Any]) -> tuple[bool, float, str]:
    """Return the common settings of trainings that are compared."""
    return not record["upright"], record["seconds"], record.get("initial_checkpoint") or ""


def extrapolate(title: str, trained: Sequence[dict[str, Any]], by: str) -> list[str]:
    """Return how scores grow with the key `by`, and its extrapolated value for the scores of the paper."""
    ordered = sorted(trained, key=lambda one: one[by])
    if not ordered or ordered[-1][by] < 2 * ordered[0][by]:  # too close for a fit
        return []
    table = [markdown_row((by, "SSIM", "PSNR")), markdown_row(["---"] * 3)]
    table += [markdown_row((f"{one[by]:,}", f"{one['ssim']:.4f}", f"{one['psnr']:.2f}")) for one in ordered]
    logs = np.log2([one[by] for one in ordered])
    statements = []
    for metric, (paper, digits) in PAPER.items():
        slope, offset = np.polyfit(logs, [one[metric] for one in ordered], 1)
        grown = f"{metric.upper()} grows by {slope:.{digits}f} for each doubling"
        statements.append(f"{grown} and reaches the paper's {paper} after {2 ** ((paper - offset) / slope):.1e} {by}")
    line = f"On a line through these {len(ordered)} points, {'; '.join(statements)}. This is an extrapolation, not a measurement."
    return ["", f"{title}:", "", *table, "", line]


if __name__ == "__main__":
    main()
