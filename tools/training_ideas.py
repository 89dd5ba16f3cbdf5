"""Tries ideas for the inversion network in short trainings of equal processor time, and ranks them on `tune.txt`.

    python tools/training_ideas.py --data ../shared/data --work work/ideas [--idea NAME ...] [--seconds 600] [--start FILE]

Each idea differs from what `bench train` does in what IDEAS says of it. All train on raw descriptors of the photographs of
`train/` that are in neither list, from random weights or from a trained network's, and are scored on the 100 of `tune.txt`. What
came out is kept in docs/ideas.jsonl, a line a training, and the page docs/ideas.md is written from it.
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
from make_assets import part
from perceptual_loss import classifiers, unlike, vgg_file, vggs
from torch import Tensor, nn

from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.images.photographs import list_photographs
from bench.images.views import PhotographView, collect_views
from bench.inversion import weights
from bench.inversion.data import Example, Examples
from bench.inversion.encoding import CELL, EncodedRelease
from bench.inversion.learner import Learner
from bench.inversion.loss import LUMA, WEIGHT, ssim
from bench.inversion.network import Inverter, Shape
from bench.inversion.plan import Training
from bench.inversion.reconstruct import reconstruct_image
from bench.inversion.symmetry import IDENTITY, Symmetry, find_symmetries
from bench.inversion.train import build_batch, score, validate
from bench.types import Descriptors, Points
from defenses.none import Undefended
from bench.core.table import markdown_row

DOCS = Path(__file__).parents[1] / "docs"
LOG, PAGE = DOCS / "ideas.jsonl", DOCS / "ideas.md"
SIZES = ("crops", "parameters", "photographs", "date")
WARMUP = 50  # steps; fewer than `bench train` takes, for these trainings are short
UNCHANGED = "as bench train"
PAPER = {"ssim": (0.6878, 3), "psnr": (18.59, 2)}  # its row of raw descriptors, and digits
VGG = "loss: what VGG sees"
UNTURNED = "not turned"  # but mirrored, as half of the views are
INPUTS = 128 + 2  # a raw descriptor, and the place within a cell


# ---- losses


def loss(
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
    """A weighted sum: 1 - SSIM of luminance, L1, root and logarithm of each image's square error, L1 of four coarser scales, of
    differences between neighbouring pixels, and of what a classifier sees, or VGG. By default it is `bench train`'s."""
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
    for weight, eye in ((classifier, classifiers), (vgg, vggs)):
        if weight:
            total = total + weight * unlike(reconstruction, photograph, eye)
    return total


# ---- networks


class Attentive(Inverter):
    """Before anything is scattered, keypoints look at those nearest to them."""

    def __init__(self, shape: Shape, blocks: int) -> None:
        super().__init__(shape)
        self.blocks = nn.ModuleList(Neighbours(shape.hidden) for _ in range(blocks))

    def embed_points(self, points: EncodedRelease) -> Tensor:
        hidden = super().embed_points(points)
        near, apart = nearest(points.image, points.places * CELL, Neighbours.count)
        for block in self.blocks:
            hidden = block(hidden, near, apart)
        return hidden


class Neighbours(nn.Module):
    """Attention of each keypoint to those nearest to it, by what they are and where they lie; then a layer of its own."""

    count = 12
    heads, width = 4, 24

    def __init__(self, hidden: int) -> None:
        super().__init__()
        inner = self.heads * self.width
        self.norm = nn.LayerNorm(hidden)
        self.query, self.seen = nn.Linear(hidden, inner), nn.Linear(hidden, 2 * inner)
        self.where = nn.Sequential(nn.Linear(6, 32), nn.SiLU(), nn.Linear(32, self.heads + inner))
        self.out = nn.Linear(inner, hidden)
        last = nn.Linear(hidden, hidden)
        self.own = nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.SiLU(), last)
        nn.init.zeros_(self.out.weight)  # a block begins as one that changes nothing
        nn.init.zeros_(last.weight)

    def forward(self, hidden: Tensor, near: Tensor, apart: Tensor) -> Tensor:
        """(P, hidden), (P, k) their neighbours, (P, k, 6) how they lie -> (P, hidden)"""
        count, inner = near.shape[1], self.heads * self.width
        normed = self.norm(hidden)
        query = self.query(normed).view(-1, 1, self.heads, self.width)
        key, value = self.seen(normed)[near].split(inner, dim=2)
        bias, moved = self.where(apart).split([self.heads, inner], dim=2)
        weight = (query * key.view(-1, count, self.heads, self.width)).sum(dim=3) / self.width**0.5 + bias
        value = (value + moved).view(-1, count, self.heads, self.width)
        gathered = (weight.softmax(dim=1)[..., None] * value).sum(dim=1)
        hidden = hidden + self.out(gathered.reshape(-1, inner))
        return hidden + self.own(hidden)


@torch.no_grad()
def nearest(image: Tensor, place: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The nearest keypoints of the same image, (P, k), and offset, direction and distance to each, (P, k, 6)."""
    found, start = [], 0
    for many in torch.bincount(image).tolist():
        here = place[start : start + many]
        near = torch.cdist(here, here).topk(min(count, many), largest=False).indices
        found.append(nnf.pad(near, (0, count - near.shape[1]), mode="replicate") + start)
        start += many
    near = torch.cat(found)
    offset = (place[near] - place[:, None]) / 16
    distance = offset.norm(dim=2, keepdim=True)
    shapes = [offset.clamp(-4, 4) / 2, offset / (distance + 1e-3), torch.log1p(distance), torch.exp(-distance)]
    return near, torch.cat(shapes, dim=2)


# ---- more photographs from fewer


def zoomed(example: Example, share: float, rng: np.random.Generator) -> Example:
    """Some square within the crop, its side at least `share` of the crop's, as large as the crop was. A descriptor is of the
    keypoint's own scale, so that it stays nearly the same."""
    side = len(example.pixels)
    window = int(rng.integers(round(share * side), side + 1))
    left, top = rng.integers(side - window + 1, size=2)
    moved = (example.release.keypoints - np.array([left, top], dtype=np.float32)) * np.float32(side / window)
    inside = np.all((moved >= 0) & (moved < side), axis=1)
    if not inside.any():
        return example
    seen = example.pixels[top : top + window, left : left + window]
    pixels = np.asarray(cv2.resize(seen, (side, side), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    assert isinstance(example.release, Descriptors)
    release = dataclasses.replace(
        example.release, positions=Points(keypoints=moved[inside]), descriptors=example.release.descriptors[inside], frames=None
    )
    return dataclasses.replace(example, pixels=pixels, release=release)


def relit(example: Example, most: float, rng: np.random.Generator) -> Example:
    """Brighter or darker, of more or less contrast, up to a share: descriptors of normed gradients stay the same."""
    contrast, brightness = 1 + rng.uniform(-most, most), rng.uniform(-most, most)
    pixels = np.clip((example.pixels / 255 - 0.5) * contrast + 0.5 + brightness, 0, 1)
    return dataclasses.replace(example, pixels=np.round(255 * pixels).astype(np.uint8))


def thinned(points: EncodedRelease, share: float, rng: np.random.Generator) -> EncodedRelease:
    """Without a share of the keypoints."""
    kept = torch.from_numpy(rng.random(len(points.image)) >= share)
    return dataclasses.replace(points, **{name: getattr(points, name)[kept] for name in ("values", "places", "image")})


# ---- schedules


def falling(last: float) -> Callable[[float], float]:
    """The rate at its peak, and in the last share of the training falling to zero in a line."""
    return lambda done: math.acos(2 * min(1.0, (1 - done) / last) - 1) / math.pi  # where the cosine is at that rate


# ---- ideas


@dataclass(frozen=True, kw_only=True)
class Idea:
    """What is done otherwise."""

    shape: dict[str, Any] = field(default_factory=dict)
    attention: int = 0  # blocks
    loss: dict[str, float] = field(default_factory=dict)
    training: dict[str, Any] = field(default_factory=dict)
    photographs: int = 800
    dropped: float = 0.0  # share of keypoints
    zoomed: float = 1.0  # least share of a crop's side that is looked at
    relit: float = 0.0  # share of the range by which brightness and contrast change, at most
    upright: bool = True
    turned: bool = True
    schedule: Callable[[float], float] = float  # share of the training that is done -> where the cosine is then

    def network(self) -> Inverter:
        shape = Shape(**{"inputs": INPUTS} | self.shape)
        return Attentive(shape, self.attention) if self.attention else Inverter(shape)

    def measured(self, reconstruction: Tensor, photograph: Tensor) -> Tensor:
        return loss(reconstruction, photograph, **self.loss)

    def drawn(self, examples: Examples, rng: np.random.Generator) -> Example:
        example = examples.draw(rng)
        example = zoomed(example, self.zoomed, rng) if self.zoomed < 1 else example
        return relit(example, self.relit, rng) if self.relit else example


IDEAS = {
    UNCHANGED: Idea(),
    "loss: rmse for l1": Idea(loss={"l1": 0.0, "rmse": 1.0}),
    "loss: psnr beside l1": Idea(loss={"psnr": 0.05}),
    "loss: coarser scales": Idea(loss={"coarse": 0.25}),
    "loss: gradients": Idea(loss={"gradient": 0.5}),
    "loss: more ssim": Idea(loss={"dissimilarity": 0.6}),
    "loss: psnr for l1": Idea(loss={"l1": 0.0, "psnr": 0.05}),
    "loss: what a classifier sees": Idea(loss={"classifier": 0.1}),
    VGG: Idea(loss={"vgg": 0.1}),
    "rate that falls in a line": Idea(schedule=falling(1.0)),
    "rate that falls at the end": Idea(schedule=falling(0.3)),
    "rate 8e-3": Idea(training={"rate": 8e-3}),
    "rate 2e-3": Idea(training={"rate": 2e-3}),
    "batches of 4": Idea(training={"batch": 4}),
    "batches of 16": Idea(training={"batch": 16}),
    "short average": Idea(training={"average": 0.99}),
    "half the channels": Idea(shape={"widths": (16, 32, 56, 56)}),
    "half as many channels again": Idea(shape={"widths": (48, 96, 168, 168)}),
    "twice the channels, 320 hidden": Idea(shape={"widths": (64, 128, 224, 224), "hidden": 320}),
    "twice the channels at the bottom": Idea(shape={"widths": (32, 64, 128, 224)}),
    "a level more": Idea(shape={"widths": (32, 64, 112, 112, 112)}),
    "192 hidden": Idea(shape={"hidden": 192}),
    "320 hidden": Idea(shape={"hidden": 320}),
    "512 hidden": Idea(shape={"hidden": 512}),
    "patches of 10": Idea(shape={"patch": 10}),
    "patches of 2": Idea(shape={"patch": 2}),
    "keypoint dropout": Idea(dropped=0.2),
    "zoomed": Idea(zoomed=0.7),
    "brightness and contrast": Idea(relit=0.1),
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
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument("--work", type=Path, required=True, help="features are kept here")
    parser.add_argument("--idea", choices=IDEAS, action="append", help="one to try, may be repeated; all that can be by default")
    parser.add_argument("--seconds", type=float, default=600, help="of processor time, all threads together, for each")
    parser.add_argument("--start", type=Path, help="a network for raw descriptors to start from, instead of random weights")
    args = parser.parse_args()
    for name in args.idea or [name for name in IDEAS if name != VGG or vgg_file().is_file()]:
        try:
            record = {"idea": name, "date": time.strftime("%Y-%m-%d"), **tried(IDEAS[name], args)}
        except UserError as error:
            parser.error(str(error))
        print(record, flush=True)
        with LOG.open("a", encoding="utf-8") as log:
            log.write(json.dumps(record) + "\n")
        PAGE.write_text(page([json.loads(line) for line in LOG.read_text(encoding="utf-8").splitlines()]), encoding="utf-8")


def tried(idea: Idea, args: argparse.Namespace) -> dict[str, Any]:
    """Train for as long as is given, and score the averaged weights."""
    photographs, tune = (seen(args, which, idea.upright) for which in ("012", "tune"))
    known = find_symmetries(Sift(upright=idea.upright))
    under = known if idea.turned else (IDENTITY,)
    examples = Examples(photographs[: 4 * idea.photographs], Undefended(), {}, {}, Public(), under)
    unseen = Examples(tune, Undefended(), {}, {}, Public())
    torch.manual_seed(0)
    network, training = idea.network(), {"warmup": WARMUP, **idea.training}
    if args.initial_checkpoint:
        network.load_state_dict(weights.load(args.initial_checkpoint).module.state_dict())
        training = {"rate": 1e-3, **training}  # as tools/make_assets.py goes on from its start
    learner = Learner(network, Training(**training), idea.measured)
    crops = fit(learner, examples, idea, args.seconds)
    network = learner.load_average()
    scores = validate(network, unseen, tune[::4], 1, "invariant")
    averaged = shown(network, known, tune[::4])
    parameters = sum(weight.numel() for weight in network.parameters())
    return {
        "upright": idea.upright,
        "seconds": args.seconds,
        "start": args.initial_checkpoint and args.initial_checkpoint.stem,
        "trained_on": idea.photographs,
        "crops": crops,
        "parameters": parameters,
        **{metric: scores[metric] for metric in ("mae", "ssim", "psnr")},
        "shown": averaged,
    }


def fit(learner: Learner[Inverter], examples: Examples, idea: Idea, seconds: float) -> int:
    """Train for as long as is given. -> crops seen"""
    started, told = time.process_time(), 0
    with Progress("training", round(seconds)) as progress:
        while (share := (time.process_time() - started) / seconds) < 1:
            rng = np.random.default_rng([0, learner.step])
            points, photographs = build_batch([idea.drawn(examples, rng) for _ in range(learner.training.batch)], 1, "invariant")
            points = thinned(points, idea.dropped, rng) if idea.dropped else points
            value = float(learner.learn(points, photographs, idea.schedule(share)))
            progress.advance(int(seconds * share) - told, f"loss {value:.4f}, {learner.step} steps")
            told = int(seconds * share)
    return learner.step * learner.training.batch


def shown(network: nn.Module, known: Sequence[Symmetry], views: Sequence[PhotographView]) -> dict[str, float]:
    """Mean SSIM and PSNR of the average of what is painted under all symmetries, as `dia` shows it."""
    scores = []
    for view in views:
        raw = view.features
        release = Descriptors(positions=Points(keypoints=raw.keypoints), size=raw.size, descriptors=raw.descriptors)
        image = reconstruct_image(network, release, known, np.empty(0, np.float32), 1, "invariant")
        scores.append(score(*(torch.from_numpy(pixels).permute(2, 0, 1) for pixels in (image, view.pixels / np.float32(255)))))
    _, similarity, psnr = np.mean(scores, axis=0)
    return {"times": len(known), "ssim": float(similarity), "psnr": float(psnr)}


def seen(args: argparse.Namespace, which: str, upright: bool) -> list[PhotographView]:
    """All views of a set of photographs, extracted once."""
    kept = args.work / f"{which}-{'upright' if upright else 'oriented'}.pickle"
    if not kept.is_file():
        args.work.mkdir(parents=True, exist_ok=True)
        folders = part(args.data, args.work / "photographs")
        kept.write_bytes(pickle.dumps(collect_views(list_photographs(folders[which]), Sift(upright=upright))))
    found: list[PhotographView] = pickle.loads(kept.read_bytes())
    return found


def page(records: Sequence[dict[str, Any]]) -> str:
    """docs/ideas.md: what was trained equally long stands together, the best first."""
    lines = [
        "# Ideas for the inversion network",
        "",
        "Written by `tools/training_ideas.py`, which says what each idea is. Raw descriptors; trainings in equal processor time, from "
        "random weights but where a start is named; scores on the 100 photographs of `tune.txt` (SSIM where its window fits). "
        "Short trainings favour what learns fast, and each was done once: read small differences as none. *Shown*: painted of "
        "what the photograph mirrored, or turned, too, would have released, so many times, and averaged. *Earlier*: another "
        "layout or optimizer, which the history of this repository has, but for Muon without two layers, of which the name says "
        "all. Trainings of more than 10 minutes are `bench train`'s, and their minutes its threads' by the clock; "
        "what is shipped was trained in legs, each from where the one before ended.",
    ]
    for group in sorted({equal(record) for record in records}):
        oriented, seconds, start = group
        here = [record for record in records if equal(record) == group]
        kind, origin = "Oriented" if oriented else "Upright", f", from `{start}`" if start else ""
        lines += ["", f"## {kind} SIFT, {seconds / 60:g} minutes of one core{origin}", ""]
        lines += [markdown_row(("idea", "MAE", "SSIM, PSNR", "shown", *SIZES))]
        lines += [markdown_row(["---"] * 8)]
        for record in sorted(here, key=lambda record: -record["ssim"]):
            averaged = record["shown"]
            scores = [f"{record['mae']:.4f}", f"{record['ssim']:.4f}, {record['psnr']:.2f}"]
            scores += [f"{averaged['ssim']:.4f}, {averaged['psnr']:.2f} ({averaged['times']})"]
            sizes = f"{record['crops']:,}", f"{record['parameters'] / 1e6:.1f} M"
            lines.append(markdown_row((record["idea"], *scores, *sizes, record["trained_on"], record["date"])))
    alone = [record for record in records if record["upright"] and not record.get("start")]
    lines += ["", "## How the gap closes", "", "Painted once; upright, from random weights, where nothing else is said."]
    for idea in (UNCHANGED, UNTURNED):
        whole = [record for record in alone if record["idea"] == idea]
        fewer = [record for record in alone if record["idea"] in (f"{idea}; 200 photographs", f"{idea}; 400 photographs")]
        longest = max((record["seconds"] for record in fewer), default=0)
        same = [record for record in whole if record["seconds"] == longest]
        lines += extrapolation(f"{idea.capitalize()}, the more crops", whole, "crops")
        lines += extrapolation(
            f"{idea.capitalize()}, the more photographs, in {longest / 60:g} minutes", fewer + same, "trained_on"
        )
    for upright, first in ((True, UNTURNED), (False, f"{UNTURNED}; oriented")):
        same = [record for record in records if record["upright"] == upright]
        legs = [record for record in same if record["idea"] == first and not record.get("start")]
        # `before`: the crops that its start had seen, in rows of `bench train`, which are added by hand.
        legs += [record | {"crops": record["before"] + record["crops"]} for record in same if "before" in record]
        kind = "upright" if upright else "oriented"
        lines += extrapolation(f"Leg by leg, {kind}, the first not turned, the more crops in all", legs, "crops")
    return "\n".join(lines) + "\n"


def equal(record: dict[str, Any]) -> tuple[bool, float, str]:
    """What trainings that are compared have in common."""
    return not record["upright"], record["seconds"], record.get("start") or ""


def extrapolation(told: str, trained: Sequence[dict[str, Any]], by: str) -> list[str]:
    """How scores grow with what is kept under `by`, and how much of it the paper's would take if that went on."""
    ordered, name = sorted(trained, key=lambda one: one[by]), "photographs" if by == "trained_on" else by
    if not ordered or ordered[-1][by] < 2 * ordered[0][by]:  # too near to each other for a line
        return []
    table = [markdown_row((name, "SSIM", "PSNR")), markdown_row(["---"] * 3)]
    table += [markdown_row((f"{one[by]:,}", f"{one['ssim']:.4f}", f"{one['psnr']:.2f}")) for one in ordered]
    logs = np.log2([one[by] for one in ordered])
    said = []
    for metric, (paper, digits) in PAPER.items():
        slope, offset = np.polyfit(logs, [one[metric] for one in ordered], 1)
        grown = f"{metric.upper()} grows by {slope:.{digits}f} for each doubling"
        said.append(f"{grown}, and would be the paper's {paper} after {2 ** ((paper - offset) / slope):.1e} {name}")
    line = f"By a line through these {len(ordered)}, {'; '.join(said)}. That is an extrapolation, and no measurement."
    return ["", f"{told}:", "", *table, "", line]


if __name__ == "__main__":
    main()
