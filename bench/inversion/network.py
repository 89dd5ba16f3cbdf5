"""The inversion network: an MLP embeds each keypoint, embeddings are scattered to a grid, a U-Net reconstructs the photograph.

A small version of Pittaluga et al. (CVPR 2019) and Dosovitskiy and Brox (CVPR 2016). The grid has one cell per 4 x 4 pixels. The
position of a keypoint within its cell is an input of its embedding. Coarse levels have most channels. Each keypoint also adds a
patch around itself, as wide as the support of its descriptor. Convolutions of a sparse map reach so far only in deep layers.

If several keypoints lie in one cell, their embeddings are summed, and an extra channel counts them. Patches are summed as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from bench.inversion.encoding import CELL, EncodedRelease

MIN_LOG_POSTERIOR = -12.0  # smaller ones are the same to the network
COARSENET = (256, 256, 256, 512, 512, 512)  # its encoder's channels (Pittaluga et al., CVPR 2019)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The network's sizes."""

    inputs: int  # numbers per keypoint
    candidates: int = 0  # candidates that are embedded one by one and summed; 0: all numbers are embedded together
    length: int = 0  # of one candidate
    posteriors: bool = False  # each candidate is weighted by its posterior (`bench.context.reconstruct`)
    hidden: int = 256  # width of the embedding MLP
    widths: tuple[int, ...] = (32, 64, 112, 112)  # channels at 1/4, 1/8, ... of the image's side
    last: int = 32  # channels at 1/2
    patch: int = 6  # cells: the side of the patch around a keypoint
    painted: int = 16  # channels of the patch; the name is part of the file format
    samples: int = 0  # points on each line of a network that reads lines (`bench.inversion.line_network`); 0: it reads points


class GridNetwork(nn.Module):
    """Points of B releases -> features of each cell: the part that all networks for points have in common."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        first = shape.widths[0]
        self.shape = shape
        common = shape.inputs - max(0, shape.candidates - 1) * shape.length
        self.embed = nn.Sequential(
            nn.Linear(shape.length + 2 if shape.posteriors else common, shape.hidden),
            nn.SiLU(inplace=True),
            nn.Linear(shape.hidden, shape.hidden),
            nn.SiLU(inplace=True),
        )
        if shape.posteriors:
            self.weigh = nn.Sequential(nn.Linear(4, 16), nn.SiLU(), nn.Linear(16, 1))
            self.alone = nn.Sequential(nn.Linear(5, 64), nn.SiLU(), nn.Linear(64, shape.hidden))
        self.own = nn.Linear(shape.hidden, first - 1)
        self.around = nn.Linear(shape.hidden, shape.patch**2 * shape.painted)
        self.channels = first + shape.painted  # of the grid
        self.stem = conv_norm(self.channels, first)
        pairs = list(itertools.pairwise(shape.widths))
        self.down = nn.ModuleList(nn.Sequential(conv_norm(narrow, wide, stride=2), Residual(wide)) for narrow, wide in pairs)
        self.up = nn.ModuleList(Up(wide, narrow) for narrow, wide in reversed(pairs))

    def refine_grid(self, cells: Tensor, shifts: Sequence[Tensor] | None = None) -> Tensor:
        """The U-Net. (B, first + painted, H/4, W/4) -> (B, first, H/4, W/4), with a margin up to a multiple of the deepest level

        `shifts` (B, width, 1, 1) are added to the levels on the way down.
        """
        rows, columns = cells.shape[2:]
        step = 2 ** len(self.down)  # cell size of the deepest level; other image sizes get an empty margin
        level = nnf.pad(cells, (0, -columns % step, 0, -rows % step))
        levels = []
        for number, down in enumerate((self.stem, *self.down)):
            level = down(level)
            if shifts is not None:
                level = level + shifts[number]
            levels.append(level)
        level = levels.pop()
        for up in self.up:
            level = up(level, levels.pop())
        return level

    def scatter(self, points: EncodedRelease) -> Tensor:
        """Sum the embeddings and patches of keypoints in a grid. -> (B, first + painted, H/4, W/4), channels last"""
        hidden = self.embed_points(points)
        own = self.own(hidden)
        with_count = torch.cat([own, torch.ones_like(own[:, :1])], dim=1)
        if points.weights is not None:
            with_count = with_count * points.weights[:, None]
        cells = sum_by_cell(with_count, points.image, points.coordinates.long(), (points.batch, *points.grid))
        return torch.cat([cells, self.scatter_patches(hidden, points)], dim=3).permute(0, 3, 1, 2)

    def scatter_patches(self, hidden: Tensor, points: EncodedRelease) -> Tensor:
        """Sum the patches around keypoints in a grid, without the parts outside the image. -> (B, H/4, W/4, painted)"""
        side, (rows, columns) = self.shape.patch, points.grid
        corner = (points.coordinates + (side + 1) / 2).long()  # (P, 2) in a grid with a margin of one patch width on all sides
        steps = torch.arange(side, device=corner.device)
        row, column = corner[:, 1, None, None] + steps[:, None], corner[:, 0, None, None] + steps  # (P, side, 1), (P, 1, side)
        cells = torch.stack(torch.broadcast_tensors(column, row), dim=3).view(-1, 2)
        patches = self.around(hidden)  # (P, side side painted)
        if points.weights is not None:
            patches = patches * points.weights[:, None]
        shape = points.batch, rows + 2 * side, columns + 2 * side
        grid = sum_by_cell(patches.view(-1, self.shape.painted), points.image.repeat_interleave(side * side), cells, shape)
        return grid[:, side : side + rows, side : side + columns]

    def embed_points(self, points: EncodedRelease) -> Tensor:
        """Embed each keypoint. -> (P, hidden)"""
        if self.shape.posteriors:
            return self.embed_with_posteriors(points.values)
        return self.embed_set(points.values) if self.shape.candidates else self.embed(points.values)

    def embed_set(self, values: Tensor) -> Tensor:
        """Embed each candidate with the common inputs, and sum over candidates in any order. (P, F) -> (P, hidden)"""
        count, length = self.shape.candidates, self.shape.length
        candidates = values[:, : count * length].view(-1, count, length)  # (P, m, D)
        common = values[:, None, count * length :].expand(-1, count, -1)
        hidden = self.embed(torch.cat([candidates, common], dim=2))  # (P, m, hidden)
        present = candidates.any(dim=2)[..., None]  # not padding
        return (hidden * present).sum(dim=1) / present.sum(dim=1).clamp(min=1).sqrt()

    def embed_with_posteriors(self, values: Tensor) -> Tensor:
        """Embed each candidate, and sum the embeddings weighted by posteriors. (P, F) -> (P, hidden)

        A row holds m candidates, the position in the cell, the log posteriors of each candidate and of none of them, and two
        numbers for the defense: the prior log odds of a candidate and m, both divided by 4. The weight of a candidate is its
        posterior times a learned function of the posterior and of the defense, from e^-3 to e^3.
        """
        length = self.shape.length
        count = (values.shape[1] - 5) // (length + 1)  # m
        candidates = values[:, : count * length].view(-1, count, length)
        within, logs, none, defense = values[:, count * length :].split((2, count, 1, 2), dim=1)
        posteriors = logs.exp()
        limited = logs.clamp(min=MIN_LOG_POSTERIOR) / 4
        evidence = torch.stack([limited, posteriors, *(part.expand(-1, count) for part in defense.split(1, dim=1))], dim=2)
        weights = posteriors * self.weigh(evidence)[:, :, 0].float().clamp(-3, 3).exp()
        hidden = self.embed(torch.cat([candidates, within[:, None].expand(-1, count, -1)], dim=2))  # (P, m, hidden)
        summed = (hidden * weights[:, :, None]).sum(dim=1)
        return summed + self.alone(torch.cat([within, defense, none.clamp(min=MIN_LOG_POSTERIOR) / 4], dim=1))


class Inverter(GridNetwork):
    """Points of B releases -> (B, 3, H, W) RGB, unclamped."""

    def __init__(self, shape: Shape) -> None:
        super().__init__(shape)
        self.narrow = nn.Conv2d(shape.widths[0], shape.last, 1)
        self.refine = conv_norm(shape.last, shape.last)
        self.paint = nn.Conv2d(shape.last, 3 * (CELL // 2) ** 2, 3, padding=1)

    def forward(self, points: EncodedRelease) -> Tensor:
        return self.decode(self.scatter(points), points.size)

    def decode(self, cells: Tensor, size: tuple[int, int]) -> Tensor:
        """Reconstruct photographs of H, W pixels from a grid. (B, first + painted, H/4, W/4) -> (B, 3, H, W)"""
        half = self.refine(upsample(self.narrow(self.refine_grid(cells))))
        images = nnf.pixel_shuffle(self.paint(half), CELL // 2)
        # Sums over pixels are faster in this order of the memory than with the channels last.
        return images.to(torch.float32, memory_format=torch.contiguous_format)[:, :, : size[0], : size[1]] + 0.5


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
    """Doubles the resolution and adds the encoder's level of that resolution. Concatenation would take twice the operations."""

    def __init__(self, wide: int, narrow: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(wide, narrow, 1)
        self.join = conv_norm(narrow, narrow)
        self.refine = conv_norm(narrow, narrow)

    def forward(self, deep: Tensor, skip: Tensor) -> Tensor:
        return self.refine(self.join(upsample(self.narrow(deep)) + skip))


def upsample(level: Tensor) -> Tensor:
    """Double the resolution. (B, C, H, W) -> (B, C, 2 H, 2 W)"""
    return nnf.interpolate(level, scale_factor=2.0, mode="nearest")


def sum_by_cell(values: Tensor, image: Tensor, cells: Tensor, shape: tuple[int, int, int]) -> Tensor:
    """Sum values (P, C) by image (P,) and cell (P, 2), which is column and row, in a grid. -> (*shape, C)"""
    batch, rows, columns = shape
    indices = (image * rows + cells[:, 1]) * columns + cells[:, 0]
    return values.new_zeros(batch * rows * columns, values.shape[1]).index_add(0, indices, values).view(*shape, -1)
