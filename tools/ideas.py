"""Tries ideas for the inversion network in short trainings of equal processor time, and ranks them on `tune.txt`.

    python tools/ideas.py --data ../shared/data --work work/ideas [--idea NAME ...] [--seconds 600]

Each idea differs from what `bench train` does in what IDEAS says of it. All train from random weights, on raw descriptors of the
photographs of `train/` that are in neither list, and are scored on the 100 of `tune.txt`. What came out is kept in
docs/ideas.jsonl, a line a training, and the page docs/ideas.md is written from it.
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

import numpy as np
import torch
import torch.nn.functional as nnf
from make_assets import part
from torch import Tensor, nn

from attacks.inversion.data import Examples
from attacks.inversion.encoding import Points, encode
from attacks.inversion.loss import LUMA, WEIGHT, ssim
from attacks.inversion.mirror import mirrored
from attacks.inversion.network import Inverter, Residual, Shape, Up, conv_norm, paint
from attacks.inversion.plan import Training
from attacks.inversion.train import to_batch, validate
from bench.datasets.photographs import folder
from bench.device import pick_device, pick_dtype
from bench.features.sift import Sift
from bench.features.views import PhotographView, collect
from bench.progress import Progress
from bench.public import Public
from bench.types import Descriptors, Indices
from defenses.none import Undefended
from leaderboard.tables import markdown_row

DOCS = Path(__file__).parents[1] / "docs"
LOG, PAGE = DOCS / "ideas.jsonl", DOCS / "ideas.md"
SIZES = ("crops", "parameters", "photographs", "date")
WARMUP = 50  # steps; fewer than `bench train` takes, for these trainings are short
INPUTS = 128 + 2  # a raw descriptor, and the place within a cell


# ---- losses


def loss(painted: Tensor, photograph: Tensor, dissimilarity: float, l1: float, rmse: float, psnr: float, coarse: float) -> Tensor:
    """A weighted sum: 1 - SSIM of luminance, L1, root and logarithm of each image's square error, L1 of four coarser scales."""
    luma = torch.tensor(LUMA, device=painted.device).view(1, 3, 1, 1)
    total = dissimilarity * (1 - ssim((painted * luma).sum(dim=1), (photograph * luma).sum(dim=1)))
    total = total + l1 * (painted - photograph).abs().mean()
    if rmse or psnr:
        mse = (painted - photograph).square().mean(dim=(1, 2, 3)) + 1e-4
        total = total + rmse * mse.sqrt().mean() + psnr * mse.log().mean()
    if coarse:
        for _ in range(4):
            painted, photograph = nnf.avg_pool2d(painted, 2), nnf.avg_pool2d(photograph, 2)
            total = total + coarse * (painted - photograph).abs().mean()
    return total


# ---- networks


def positions(points: Points) -> tuple[Tensor, Tensor]:
    """Each keypoint's image, (P,), and position in pixels, (P, 2)."""
    rows, columns = points.grid
    image, cell = points.cells // (rows * columns), points.cells % (rows * columns)
    corner = torch.stack([cell % columns, cell // columns], dim=1)
    return image, (corner + points.values[:, 128:130] + 0.5) * 2


class Quarter(nn.Module):
    """Points are scattered to cells of 4 x 4 pixels instead of 2 x 2, where the U-Net then begins and all but ends."""

    def __init__(
        self,
        widths: Sequence[int] = (64, 160, 224, 224),
        hidden: int = 320,
        patch: int = 0,  # cells: the side of what each keypoint paints around itself beside its own cell; 0: nothing
        painted: int = 16,  # channels of that
        attention: int = 0,  # blocks that look at the nearest keypoints, before anything is scattered
        last: int = 32,  # channels at half of the image's side
        deep: int = 1,  # residual blocks a level
        joined: bool = True,  # whether the encoder's levels are joined to the decoder's, or added to them
        glances: int = 0,  # blocks of attention over the deepest level but one
    ) -> None:
        super().__init__()
        first, *deeper = widths
        self.patch, self.painted = patch, painted
        self.embed = nn.Sequential(nn.Linear(INPUTS, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU())
        self.attention = nn.ModuleList(Neighbours(hidden) for _ in range(attention))
        self.cell = nn.Linear(hidden, first - 1)
        self.around = nn.Linear(hidden, patch * patch * painted) if patch else None
        self.stem = conv_norm(first + (painted if patch else 0), first)
        pairs = list(zip(widths[:-1], deeper, strict=True))
        self.down = nn.ModuleList(
            nn.Sequential(conv_norm(narrow, wide, stride=2), *(Residual(wide) for _ in range(deep))) for narrow, wide in pairs
        )
        self.up = nn.ModuleList((Up if joined else Added)(wide, narrow) for narrow, wide in reversed(pairs))
        self.glances = nn.ModuleList(Glance(deeper[-1]) for _ in range(glances))
        self.narrow = nn.Conv2d(first, last, 1)
        self.refine = conv_norm(last, last)
        self.paint = nn.Conv2d(last, 12, 3, padding=1)

    def forward(self, points: Points) -> Tensor:
        image, place = positions(points)
        side = points.grid[0] // 2
        cell = (place / 4).long().clamp(0, side - 1)
        hidden = self.embed(torch.cat([points.values[:, :128], place / 4 - cell - 0.5], dim=1))
        if self.attention:
            near, apart = nearest(image, place, Neighbours.count)
            for block in self.attention:
                hidden = block(hidden, near, apart)
        own = self.cell(hidden)
        grid = scattered(torch.cat([own, torch.ones_like(own[:, :1])], dim=1), image, cell, side, points.batch)
        if self.around is not None:
            grid = torch.cat([grid, self.patches(hidden, image, place, side, points.batch)], dim=3)
        level = self.stem(grid.permute(0, 3, 1, 2))
        levels = [level]
        for down in self.down:
            levels.append(down(levels[-1]))
        level = levels.pop()
        for glance in self.glances:
            level = glance(level)
        for up in self.up:
            level = up(level, levels.pop())
        grown = nnf.interpolate(self.narrow(level), scale_factor=2.0, mode="nearest")
        return nnf.pixel_shuffle(self.paint(self.refine(grown)).float(), 2) + 0.5

    def patches(self, hidden: Tensor, image: Tensor, place: Tensor, side: int, batch: int) -> Tensor:
        """What each keypoint paints around itself, added up. -> (B, side, side, painted)"""
        assert self.around is not None
        size, wide = self.patch, side + 2 * self.patch  # with a margin for what lies outside
        corner = (place / 4 + (0.5 if size % 2 == 0 else 0.0)).long() - size // 2 + size
        steps = torch.arange(size, device=place.device)
        row = corner[:, 1, None, None].clamp(0, wide - size) + steps[:, None]
        column = corner[:, 0, None, None].clamp(0, wide - size) + steps
        cells = torch.stack(torch.broadcast_tensors(column, row), dim=3).view(-1, 2)
        painted = self.around(hidden).view(-1, self.painted)
        grid = scattered(painted, image.repeat_interleave(size * size), cells, wide, batch)
        return grid[:, size : size + side, size : size + side]


class Added(nn.Module):
    """As `Up`, with half of its operations: the encoder's level is added."""

    def __init__(self, wide: int, narrow: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(wide, narrow, 1)
        self.join, self.refine = conv_norm(narrow, narrow), conv_norm(narrow, narrow)

    def forward(self, deep: Tensor, skip: Tensor) -> Tensor:
        return self.refine(self.join(nnf.interpolate(self.narrow(deep), scale_factor=2.0, mode="nearest") + skip))


class Glance(nn.Module):
    """Attention of every cell to every other, and a layer of its own. (B, C, H, W) -> the same."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm, self.other = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.attend = nn.MultiheadAttention(channels, 4, batch_first=True)
        self.own = nn.Sequential(nn.Linear(channels, 2 * channels), nn.SiLU(), nn.Linear(2 * channels, channels))

    def forward(self, level: Tensor) -> Tensor:
        cells = level.flatten(2).transpose(1, 2)
        normed = self.norm(cells)
        cells = cells + self.attend(normed, normed, normed, need_weights=False)[0]
        cells = cells + self.own(self.other(cells))
        return cells.transpose(1, 2).reshape(level.shape).to(level.dtype)


def scattered(values: Tensor, image: Tensor, cell: Tensor, side: int, batch: int) -> Tensor:
    """(P, C) values added up in cells (column, row). -> (B, side, side, C)"""
    places = (image * side + cell[:, 1]) * side + cell[:, 0]
    grid = values.new_zeros(batch * side * side, values.shape[1]).index_add(0, places, values)
    return grid.view(batch, side, side, -1)


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


# ---- ideas


@dataclass(frozen=True, kw_only=True)
class Idea:
    """What is done otherwise."""

    network: Callable[[], nn.Module] = lambda: Inverter(Shape(inputs=INPUTS))
    loss: dict[str, float] = field(default_factory=dict)
    batch: int = Training.batch
    rate: float = Training.rate
    decay: float = Training.decay
    average: float = Training.average
    photographs: int = 800
    dropped: float = 0.0  # share of keypoints
    upright: bool = True


AS_IT_IS = {"dissimilarity": WEIGHT, "l1": 1.0, "rmse": 0.0, "psnr": 0.0, "coarse": 0.0}
IDEAS = {
    "as bench train": Idea(),
    "loss: rmse for l1": Idea(loss={"l1": 0.0, "rmse": 1.0}),
    "loss: psnr beside l1": Idea(loss={"psnr": 0.05}),
    "loss: psnr for l1": Idea(loss={"l1": 0.0, "psnr": 0.1}),
    "loss: coarser scales": Idea(loss={"coarse": 0.25}),
    "rate 4e-3": Idea(rate=4e-3),
    "rate 1e-3": Idea(rate=1e-3),
    "batches of 4": Idea(batch=4),
    "batches of 16": Idea(batch=16),
    "half the channels": Idea(network=lambda: Inverter(Shape(inputs=INPUTS, widths=(16, 32, 80, 112, 112)))),
    "quarter": Idea(network=Quarter),
    "quarter, patches": Idea(network=lambda: Quarter(patch=6)),
    "quarter, patches, added": Idea(network=lambda: Quarter(patch=6, joined=False)),
    "quarter, patches, added, glances": Idea(network=lambda: Quarter(patch=6, joined=False, glances=2)),
    "quarter, patches, added, deep": Idea(network=lambda: Quarter(patch=6, joined=False, deep=2)),
    "quarter, patches, added, 512 hidden": Idea(network=lambda: Quarter(patch=6, joined=False, hidden=512)),
    "keypoint dropout": Idea(dropped=0.2),
    "short average": Idea(average=0.99),
    "quarter, attention": Idea(network=lambda: Quarter(attention=2)),
    "quarter, thin, patches": Idea(network=lambda: Quarter(widths=(48, 112, 192, 224), patch=6)),
    "200 photographs": Idea(photographs=200),
    "400 photographs": Idea(photographs=400),
    "oriented": Idea(upright=False),
    "oriented: quarter, patches": Idea(upright=False, network=lambda: Quarter(patch=6)),
    "oriented: quarter, patches, attention": Idea(upright=False, network=lambda: Quarter(patch=6, attention=2)),
}


# ---- training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument("--work", type=Path, required=True, help="features are kept here")
    parser.add_argument("--idea", choices=IDEAS, action="append", help="one to try, may be repeated; all by default")
    parser.add_argument("--seconds", type=float, default=600, help="of processor time, all threads together, for each")
    args = parser.parse_args()
    for name in args.idea or IDEAS:
        record = {"idea": name, "date": time.strftime("%Y-%m-%d"), **tried(IDEAS[name], args)}
        print(record, flush=True)
        with LOG.open("a", encoding="utf-8") as log:
            log.write(json.dumps(record) + "\n")
        PAGE.write_text(page([json.loads(line) for line in LOG.read_text(encoding="utf-8").splitlines()]), encoding="utf-8")


def tried(idea: Idea, args: argparse.Namespace) -> dict[str, Any]:
    """Train for as long as is given, and score the averaged weights."""
    training, tune = (seen(args, which, idea.upright) for which in ("012", "tune"))
    examples, unseen = (Examples(views, Undefended(), {}, {}, Public()) for views in (training[: 4 * idea.photographs], tune))
    torch.manual_seed(0)
    device = pick_device()
    network = idea.network().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    crops = fit(network, examples, idea, args.seconds)
    scores = validate(network.eval(), unseen, tune[::4], 1, "invariant")
    twice = painted_twice(network, Sift(upright=idea.upright).mirror_order(), tune[::4])
    parameters = sum(weight.numel() for weight in network.parameters())
    return {
        "upright": idea.upright,
        "seconds": args.seconds,
        "trained_on": idea.photographs,
        "crops": crops,
        "parameters": parameters,
        **{metric: scores[metric] for metric in ("mae", "ssim", "psnr")},
        "twice": twice,
    }


def fit(network: nn.Module, examples: Examples, idea: Idea, seconds: float) -> int:
    """Train, and leave the averaged weights in the network. -> crops seen"""
    device = next(network.parameters()).device
    dtype = pick_dtype(device)
    optimizer = torch.optim.AdamW(network.parameters(), idea.rate, weight_decay=idea.decay)
    average = {name: value.clone() for name, value in network.state_dict().items()}
    weights = AS_IT_IS | idea.loss
    started, step, told = time.process_time(), 0, 0
    network.train()
    with Progress("training", round(seconds)) as progress:
        while (share := (time.process_time() - started) / seconds) < 1:
            rng = np.random.default_rng([0, step])
            points, photographs = to_batch([examples.draw(rng) for _ in range(idea.batch)], 1, "invariant")
            for group in optimizer.param_groups:
                group["lr"] = idea.rate * min(1.0, (step + 1) / WARMUP) * 0.5 * (1 + math.cos(math.pi * share))
            if idea.dropped:
                kept = torch.from_numpy(rng.random(len(points.cells)) >= idea.dropped)
                points = dataclasses.replace(points, values=points.values[kept], cells=points.cells[kept])
            with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
                painted = network(points.to(device))
            value = loss(painted, photographs.to(device), **weights)
            optimizer.zero_grad(set_to_none=True)
            value.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            step += 1
            keep = min(idea.average, step / (step + 9))
            for name, weight in network.state_dict().items():
                if weight.is_floating_point():
                    average[name].lerp_(weight, 1 - keep)
            progress.advance(int(seconds * share) - told, f"loss {float(value.detach()):.4f}, {step} steps")
            told = int(seconds * share)
    network.load_state_dict(average)
    return step * idea.batch


def painted_twice(network: nn.Module, order: Indices, views: Sequence[PhotographView]) -> dict[str, float]:
    """Mean SSIM and PSNR of the average of what is painted of a release and of that of the mirrored photograph."""
    scores = []
    for view in views:
        raw = view.features
        release = Descriptors(keypoints=raw.keypoints, size=raw.size, descriptors=raw.descriptors)
        one, other = (
            paint(network, encode([seen], [np.empty(0, np.float32)], 1, "invariant")).cpu()
            for seen in (release, mirrored(release, order))
        )
        painted = (one + other.flip(3))[0] / 2
        truth = torch.from_numpy(view.pixels).permute(2, 0, 1) / 255
        scores.append((float(ssim(painted, truth)), -10 * math.log10(float((painted - truth).square().mean()))))
    similarity, psnr = np.mean(scores, axis=0)
    return {"ssim": float(similarity), "psnr": float(psnr)}


def seen(args: argparse.Namespace, which: str, upright: bool) -> list[PhotographView]:
    """All views of a set of photographs, extracted once."""
    kept = args.work / f"{which}-{'upright' if upright else 'oriented'}.pickle"
    if not kept.is_file():
        args.work.mkdir(parents=True, exist_ok=True)
        folders = part(args.data, args.work / "photographs")
        kept.write_bytes(pickle.dumps(collect(folder(folders[which]), Sift(upright=upright))))
    found: list[PhotographView] = pickle.loads(kept.read_bytes())
    return found


def page(records: Sequence[dict[str, Any]]) -> str:
    """docs/ideas.md: what was trained equally long stands together, the best first."""
    lines = [
        "# Ideas for the inversion network",
        "",
        "Written by `tools/ideas.py`, which says what each idea is. Raw descriptors; every training from random weights, in "
        "equal processor time; scores on the 100 photographs of `tune.txt` (SSIM where its window fits). Short trainings favour "
        "what learns fast, and each was done once: read small differences as none. *Twice*: painted of the release and "
        "of that of the mirrored photograph, and averaged.",
    ]
    groups = sorted({(not record["upright"], record["seconds"]) for record in records})
    for oriented, seconds in groups:
        here = [record for record in records if (not record["upright"], record["seconds"]) == (oriented, seconds)]
        kind = "Oriented" if oriented else "Upright"
        lines += ["", f"## {kind} SIFT, {seconds / 60:g} minutes of one core", ""]
        lines += [markdown_row(("idea", "MAE", "SSIM, PSNR", "twice", *SIZES))]
        lines += [markdown_row(["---"] * 8)]
        for record in sorted(here, key=lambda record: -record["ssim"]):
            once, twice = record, record["twice"]
            scores = [f"{once['mae']:.4f}", *(f"{one['ssim']:.4f}, {one['psnr']:.2f}" for one in (once, twice))]
            sizes = f"{record['crops']:,}", f"{record['parameters'] / 1e6:.1f} M"
            lines.append(markdown_row((record["idea"], *scores, *sizes, record["trained_on"], record["date"])))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
