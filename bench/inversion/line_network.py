"""The network that reads lines: it locates each keypoint on its line, and reconstructs the photograph.

Each line gives S sample points in the image. A first posterior is uniform over the samples of a line. Each round improves it:

1. Sum an embedding of each line in a grid, weighted by the posterior of each sample.
2. A small U-Net turns the grid into a field of features.
3. The log posterior of a sample increases by the product of its line's query and the field at the sample.

The inversion network then reads each line at its likeliest samples, weighted by a function of the posterior. The last field is
an additional input: it has the other samples, too.

Source: ours. The idea that a keypoint lies near the lines of its neighbours is that of Chelani et al. (3DV 2025).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from bench.inversion.encoding import EncodedLines
from bench.inversion.loss import reconstruction_loss
from bench.inversion.network import Inverter, Shape, Up, conv_norm, sum_by_cell

SAMPLES = 48  # points on each line
ROUNDS = 2
WIDTHS = (32, 40, 40)  # channels of the field and of its coarser levels
PEAKS = 2  # likeliest samples that the inversion network reads
POSTERIOR_WEIGHT = 0.1  # of the cross-entropy in the loss


class LineOutput(NamedTuple):
    """Reconstructions, and the posterior of each line."""

    images: Tensor  # (B, 3, H, W) RGB, unclamped
    logs: Tensor  # (P, S) log posterior of each sample, float32


class LineInverter(nn.Module):
    """Lines of B releases -> reconstructions and posteriors."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        self.inverter = Inverter(shape)
        self.rounds = nn.ModuleList(Round(shape.hidden) for _ in range(ROUNDS))
        last = nn.Linear(16, 1)
        self.weigh = nn.Sequential(nn.Linear(2, 16), nn.SiLU(), last)
        self.blend = nn.Conv2d(WIDTHS[0], shape.widths[0] + shape.painted, 1)
        for weight in (*last.parameters(), *self.blend.parameters()):  # untrained: posteriors alone, and no field
            nn.init.zeros_(weight)

    def forward(self, lines: EncodedLines) -> LineOutput:
        count, samples = lines.samples.shape[:2]
        middle = lines.samples[:, samples // 2 :][:, :1]
        hidden = self.inverter.embed_points(lines.pick_points(middle, torch.ones_like(middle[:, :, 0])))  # (P, hidden)
        logs = torch.zeros(count, samples, device=hidden.device).log_softmax(dim=1)
        for update in self.rounds:
            scores, field = update(hidden, logs, lines)
            logs = (logs + scores.float()).log_softmax(dim=1)
        best, indices = logs.topk(min(PEAKS, samples), dim=1)  # (P, k) twice
        weights = best.exp() * self.weigh(torch.stack([best, best.exp()], dim=2))[:, :, 0].float().clamp(-3, 3).exp()
        points = lines.pick_points(lines.samples.gather(1, indices[:, :, None].expand(-1, -1, 2)), weights)
        cells = self.inverter.scatter(points) + self.blend(field)
        return LineOutput(self.inverter.decode(cells, lines.size), logs)


class Round(nn.Module):
    """One round: embeddings and posteriors of lines -> scores of their samples, and the field."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        first, pairs = WIDTHS[0], list(itertools.pairwise(WIDTHS))
        self.send, self.ask = nn.Linear(hidden, first - 1), nn.Linear(hidden, first)
        self.stem = conv_norm(first, first)
        self.down = nn.ModuleList(conv_norm(narrow, wide, stride=2) for narrow, wide in pairs)
        self.up = nn.ModuleList(Up(wide, narrow) for narrow, wide in reversed(pairs))
        self.last = nn.Conv2d(first, first, 1)

    def forward(self, hidden: Tensor, logs: Tensor, lines: EncodedLines) -> tuple[Tensor, Tensor]:
        """(P, hidden), (P, S) -> (P, S), (B, C, H/4, W/4)"""
        count, samples = logs.shape
        rows, columns = lines.grid
        sent = self.send(hidden)
        sent = torch.cat([sent, torch.ones_like(sent[:, :1])], dim=1)  # (P, C)
        spread = (sent[:, None] * logs.exp()[:, :, None].to(sent.dtype)).view(count * samples, -1)
        cells, image = lines.samples.long().view(-1, 2), lines.image.repeat_interleave(samples)
        grid = sum_by_cell(spread, image, cells, (lines.batch, rows, columns)).permute(0, 3, 1, 2)
        field = self.last(self.refine(grid))  # (B, C, H/4, W/4)
        indices = (image * rows + cells[:, 1]) * columns + cells[:, 0]
        here = field.permute(0, 2, 3, 1).reshape(-1, field.shape[1]).index_select(0, indices).view(count, samples, -1)
        return (here @ self.ask(hidden)[:, :, None])[:, :, 0] * field.shape[1] ** -0.5, field

    def refine(self, grid: Tensor) -> Tensor:
        """The small U-Net. (B, C, H/4, W/4) -> (B, C, H/4, W/4)"""
        rows, columns = grid.shape[2:]
        step = 2 ** len(self.down)
        levels = [self.stem(nnf.pad(grid, (0, -columns % step, 0, -rows % step)))]
        for down in self.down:
            levels.append(down(levels[-1]))
        level = levels.pop()
        for up in self.up:
            level = up(level, levels.pop())
        return level[:, :, :rows, :columns]


def line_loss(output: LineOutput, photographs: Tensor, lines: EncodedLines) -> Tensor:
    """Return the loss of the reconstructions, and the cross-entropy of the true samples. -> ()"""
    if lines.truth is None:
        raise ValueError("these lines were encoded without the true keypoints")
    return reconstruction_loss(output.images, photographs) + POSTERIOR_WEIGHT * nnf.nll_loss(output.logs, lines.truth)
