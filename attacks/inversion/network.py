"""The inversion network: an MLP embeds each keypoint, embeddings are scattered to a grid, a U-Net paints the photograph.

After Pittaluga et al. (CVPR 2019) and Dosovitskiy and Brox (CVPR 2016), made small: the grid has one cell for 2 x 2 pixels, a
keypoint's place within its cell being an input of its embedding, and most channels are where cells are few.

The rule for keypoints that share a cell: their embeddings are added up, and a channel of its own counts them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from attacks.inversion.encoding import CELL, Points
from bench.device import pick_dtype

COARSENET = (256, 256, 256, 512, 512, 512)  # its encoder's channels (Pittaluga et al., CVPR 2019)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The network's sizes."""

    inputs: int  # numbers a keypoint
    candidates: int = 0  # how many of them are embedded one by one and added up; 0: all numbers are embedded together
    length: int = 0  # of one of these candidates
    hidden: int = 320  # width of the embedding MLP
    widths: tuple[int, ...] = (32, 64, 160, 224, 224)  # channels at 1/2, 1/4, ... of the image's side


class Inverter(nn.Module):
    """Points of B releases -> (B, 3, H, W) RGB, unclamped."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        first, *deeper = shape.widths
        self.shape = shape
        self.embed = nn.Sequential(
            nn.Linear(shape.inputs - max(0, shape.candidates - 1) * shape.length, shape.hidden),
            nn.SiLU(inplace=True),
            nn.Linear(shape.hidden, shape.hidden),
            nn.SiLU(inplace=True),
            nn.Linear(shape.hidden, first - 1),
        )
        self.stem = conv_norm(first, first)
        self.down = nn.ModuleList(
            nn.Sequential(conv_norm(narrow, wide, stride=2), Residual(wide))
            for narrow, wide in zip(shape.widths[:-1], deeper, strict=True)
        )
        self.up = nn.ModuleList(Up(wide, narrow) for narrow, wide in reversed(list(zip(shape.widths[:-1], deeper, strict=True))))
        self.paint = nn.Conv2d(first, 3 * CELL * CELL, 3, padding=1)

    def forward(self, points: Points) -> Tensor:
        rows, columns = points.grid
        step = 2 ** len(self.down)  # of the deepest level's grid; an image of another size is painted with an empty margin
        margin = (0, -columns % step, 0, -rows % step)
        level = self.stem(nnf.pad(self.scatter(points), margin))
        levels = [level]
        for down in self.down:
            levels.append(down(levels[-1]))
        level = levels.pop()
        for up in self.up:
            level = up(level, levels.pop())
        painted = self.paint(level)[:, :, :rows, :columns]
        return nnf.pixel_shuffle(painted.float(), CELL) + 0.5  # (B, 3, H, W)

    def scatter(self, points: Points) -> Tensor:
        """-> (B, first, H/2, W/2), channels last"""
        rows, columns = points.grid
        embedded = self.embed_set(points.values) if self.shape.candidates else self.embed(points.values)  # (P, first - 1)
        counted = torch.cat([embedded, torch.ones_like(embedded[:, :1])], dim=1)
        grid = counted.new_zeros(points.batch * rows * columns, counted.shape[1])
        grid = grid.index_add(0, points.cells, counted)
        return grid.view(points.batch, rows, columns, -1).permute(0, 3, 1, 2)

    def embed_set(self, values: Tensor) -> Tensor:
        """Embed each candidate with what goes for all, and add up: their order says nothing. (P, F) -> (P, first - 1)"""
        count, length = self.shape.candidates, self.shape.length
        candidates = values[:, : count * length].view(-1, count, length)  # (P, m, D)
        common = values[:, None, count * length :].expand(-1, count, -1)
        *layers, last = self.embed
        hidden = nn.Sequential(*layers)(torch.cat([candidates, common], dim=2))  # (P, m, hidden)
        there = candidates.any(dim=2)[..., None]  # the others are padding
        return last((hidden * there).sum(dim=1) / there.sum(dim=1).clamp(min=1).sqrt())


def conv_norm(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """x + conv(conv(x)), (B, C, H, W) -> the same."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = conv_norm(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return nnf.relu(x + self.second(self.first(x)))


class Up(nn.Module):
    """Doubles the resolution and joins the encoder's level of that resolution."""

    def __init__(self, wide: int, narrow: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(wide, narrow, 1)
        self.join = conv_norm(2 * narrow, narrow)
        self.refine = conv_norm(narrow, narrow)

    def forward(self, deep: Tensor, skip: Tensor) -> Tensor:
        grown = nnf.interpolate(self.narrow(deep), scale_factor=2.0, mode="nearest")
        return self.refine(self.join(torch.cat([grown, skip], dim=1)))


@torch.inference_mode()
def paint(module: nn.Module, points: Points) -> Tensor:
    """What an attacker shows: -> (B, 3, H, W) float32 in [0, 1]. Deterministic on one machine with one number of threads."""
    device = next(module.parameters()).device
    dtype = pick_dtype(device)
    with torch.autocast(device.type, dtype, enabled=dtype != torch.float32):
        painted: Tensor = module(points.to(device))
    return painted.clamp(0, 1)
