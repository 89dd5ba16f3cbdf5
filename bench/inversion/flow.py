"""The network that samples photographs given a release: conditional flow matching.

Source: Lipman et al., Flow Matching for Generative Modeling (ICLR 2023), with the linear path. Guidance without a classifier: Ho
and Salimans (2022).

A photograph is a grid of cells of 4 x 4 pixels. The 48 numbers of a cell are the coefficients of its discrete cosine transform
over rows, columns and colours, scaled to mean 0 and variance 1 over the training photographs. On the path

    x_t = (1 - t) noise + t photograph,    t from 0 to 1,

the network learns the mean of the velocity, photograph - noise, given x_t, t and the release. A sample starts at noise and
follows the velocity to t = 1. With probability `DROPPED` a training sample has no release. So the same network also learns the
velocity of the prior, u. With guidance w, a sample follows u + w (v - u): w = 0 gives the prior, w = 1 the posterior.

The network is the inversion network up to the features of each cell. Its input also has x_t, and t shifts the levels. A draft,
which is another network's reconstruction, can be part of it too, and is dropped together with the release. If coefficients were
independent Gaussians with the draft d as mean and with variance s², the velocity would be

    d + (t s² - (1 - t)) / D (x_t - t d),    D = (1 - t)² + t² s².

The head predicts the rest, which has variance s² / D. The variance grows with the energy of the draft around a cell, so smooth
parts remain smooth. Without a draft, d is 0 and s is 1. So an untrained network samples cells around the draft.

The path and the solver are ten lines, so no library is used. torchcfm has this path, and couplings of noise and photographs,
which do not apply if each photograph has its own release. Schedulers of diffusers expect its models. torchdiffeq adapts its
steps, and an attack needs a fixed cost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from bench.core.device import pick_dtype
from bench.inversion.encoding import CELL, Encoded, EncodedRelease, NoisyRelease
from bench.inversion.network import GridNetwork, Shape
from bench.types import Bytes

CHANNELS = 3 * CELL**2
DROPPED = 0.1  # probability of a training sample without a release
SHIFT = 3.0  # of the times in training and of the solver (`warp_time`)
FREQUENCIES = 6  # of the embedding of t
TIME_WIDTH = 64  # of the embedding of t
WIDTH = 64  # channels of the head
WINDOW = 5  # cells: side of the window of the energy of a draft
MIN_VARIANCE = 0.01  # of a coefficient around its draft
MIN_GAP = 1e-6  # least difference of energies that determines a slope

Velocity = Callable[[Tensor, float], Tensor]  # x_t, t -> velocity


class FlowNetwork(GridNetwork):
    """Points of B releases and noisy photographs -> velocities."""

    mean: Tensor  # (48, 1, 1) of the coefficients over the training photographs
    spread: Tensor  # (48, 1, 1) their standard deviation
    floor: Tensor  # (48, 1, 1) variance around a draft without energy
    slope: Tensor  # (48, 1, 1) growth of the variance with the energy of the draft

    def __init__(self, shape: Shape) -> None:
        super().__init__(shape)
        first = shape.widths[0]
        self.register_buffer("mean", torch.zeros(CHANNELS, 1, 1))
        self.register_buffer("spread", torch.ones(CHANNELS, 1, 1))
        self.register_buffer("floor", torch.ones(CHANNELS, 1, 1))
        self.register_buffer("slope", torch.zeros(CHANNELS, 1, 1))
        self.read = nn.Conv2d(2 * CHANNELS, self.channels, 1)
        self.time = nn.Sequential(nn.Linear(2 * FREQUENCIES, TIME_WIDTH), nn.SiLU())
        self.shifts = nn.ModuleList(nn.Linear(TIME_WIDTH, width) for width in shape.widths)
        last = nn.Conv2d(WIDTH, CHANNELS, 3, padding=1)
        self.head = nn.Sequential(nn.Conv2d(first + 2 * CHANNELS, WIDTH, 3, padding=1), nn.SiLU(), last)
        for weight in (*last.parameters(), *self.shifts.parameters()):  # untrained: independent Gaussians
            nn.init.zeros_(weight)

    def forward(self, batch: NoisyRelease) -> Tensor:
        """Return the error of the velocity. -> (B, 48, H/4, W/4)

        Coefficients are weighted by the root of their standard deviation, relative to the mean. It is a compromise between equal
        weights, which spend the network on noise, and weights of pixels, which ignore details.
        """
        photographs = self.to_cells(batch.photographs)
        time = batch.time[:, None, None, None]
        noisy = (1 - time) * batch.noise + time * photographs
        error = self.predict(self.build_condition(batch), noisy, batch.time) - (photographs - batch.noise)
        return error * (self.spread / self.spread.mean()).sqrt()

    def build_condition(self, points: EncodedRelease) -> Tensor:
        """Return what the network reads of releases: cells, drafts, variances around these - 1. -> (B, C, H/4, W/4)

        It is zero without a release.
        """
        cells = self.scatter(points)
        if points.drafts is None:
            rest = cells.new_zeros(points.batch, 2 * CHANNELS, *points.grid)
        else:
            drafts = self.to_cells(points.drafts)
            variance = (self.floor + self.slope * measure_energy(drafts)).clamp(min=MIN_VARIANCE)
            rest = torch.cat([drafts, variance - 1], dim=1)
            rest = rest if points.draft_weights is None else rest * points.draft_weights[:, None, None, None]
        return torch.cat([cells, rest], dim=1)

    def predict(self, condition: Tensor, noisy: Tensor, time: Tensor) -> Tensor:
        """Return the velocity. (B, C, H/4, W/4) from `build_condition`, (B, 48, H/4, W/4), (B,) -> (B, 48, H/4, W/4)"""
        rows, columns = noisy.shape[2:]
        cells, draft, excess = condition.split((self.channels, CHANNELS, CHANNELS), dim=1)
        embedded = self.time(embed_time(time))
        shifts = [shift(embedded)[:, :, None, None] for shift in self.shifts]
        images = torch.cat([noisy, draft], dim=1)
        features = self.refine_grid(cells + self.read(images), shifts)[:, :, :rows, :columns]
        rest = self.head(torch.cat([features, images.to(features.dtype)], dim=1)).float()
        time, variance = time[:, None, None, None], 1 + excess
        total = (1 - time) ** 2 + time**2 * variance
        return draft + (time * variance - (1 - time)) / total * (noisy - time * draft) + (variance / total).sqrt() * rest

    def to_cells(self, images: Tensor) -> Tensor:
        """Return the scaled coefficients of images; incomplete cells repeat the border. (B, 3, H, W) -> (B, 48, H/4, W/4)"""
        rows, columns = images.shape[2:]
        padded = nnf.pad(images, (0, -columns % CELL, 0, -rows % CELL), mode="replicate")
        return (transform_cells(nnf.pixel_unshuffle(padded, CELL)) - self.mean) / self.spread

    def to_images(self, cells: Tensor, size: tuple[int, int]) -> Tensor:
        """Return the images of H, W pixels with these scaled coefficients. (B, 48, H/4, W/4) -> (B, 3, H, W), unclamped"""
        pixels = transform_cells(cells * self.spread + self.mean, inverse=True)
        return nnf.pixel_shuffle(pixels, CELL)[:, :, : size[0], : size[1]]

    def measure_coefficients(self, photographs: Iterable[Bytes]) -> None:
        """Set mean and standard deviation of the coefficients to those of photographs (H, W, 3)."""
        moments = []
        for pixels in photographs:
            image = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1))).double()[None] / 255
            cells = transform_cells(nnf.pixel_unshuffle(image, CELL))[0]
            moments.append(torch.stack([cells.mean(dim=(1, 2)), cells.square().mean(dim=(1, 2))]))
        mean, square = torch.stack(moments).mean(dim=0)
        self.mean.copy_(mean[:, None, None])
        self.spread.copy_((square - mean**2).clamp(min=0).sqrt().clamp(min=1e-3)[:, None, None])

    def measure_variance(self, drafts: Tensor, photographs: Tensor) -> None:
        """Fit the variance around drafts: a line through the means of the cells with less and with more energy. (B, 3, H, W)

        It is constant if all cells have the same energy.
        """
        cells = self.to_cells(drafts)
        squares = (self.to_cells(photographs) - cells).square().transpose(0, 1).flatten(1)  # (48, cells)
        energy = measure_energy(cells).flatten()
        much = energy > energy.median()
        slope, floor = torch.zeros_like(squares[:, 0]), squares.mean(dim=1)
        if much.any() and (gap := energy[much].mean() - energy[~much].mean()) > MIN_GAP:
            low, high = (squares[:, part].mean(dim=1) for part in (~much, much))
            slope = ((high - low) / gap).clamp(min=0)
            floor = low - slope * energy[~much].mean()
        self.slope.copy_(slope[:, None, None])
        self.floor.copy_(floor.clamp(min=MIN_VARIANCE)[:, None, None])


def measure_energy(cells: Tensor) -> Tensor:
    """Return the mean square of the coefficients around each cell, without those of constant colour. -> (B, 1, H/4, W/4)"""
    varying = cells.unflatten(1, (3, -1))[:, :, 1:].square().mean(dim=(1, 2))  # (B, H/4, W/4)
    return nnf.avg_pool2d(varying[:, None], WINDOW, 1, WINDOW // 2, count_include_pad=False)


def transform_cells(cells: Tensor, inverse: bool = False) -> Tensor:
    """Return the orthonormal discrete cosine transform of each cell over colours, rows and columns. (B, 48, h, w) -> the same"""
    from scipy.fft import dct

    colours, pixels = (dct(np.eye(size), norm="ortho", axis=0) for size in (3, CELL))
    matrix = torch.from_numpy(np.kron(colours, np.kron(pixels, pixels))).to(cells)
    with torch.autocast(cells.device.type, enabled=False):
        return torch.einsum("ij,bjhw->bihw", matrix.T if inverse else matrix, cells)


def embed_time(time: Tensor) -> Tensor:
    """(B,) -> (B, 2 FREQUENCIES)"""
    angles = time[:, None] * math.pi * 2.0 ** torch.arange(FREQUENCIES, device=time.device)
    return torch.cat([angles.cos(), angles.sin()], dim=1)


def warp_time(fraction: float) -> float:
    """Return t of a fraction of the solver's or of the training's time, both from 0 to 1.

    The layout of a photograph is the sum of many cells, so it is decided at small t. As Esser et al. (ICML 2024).
    """
    return fraction / (fraction + SHIFT * (1 - fraction))


def add_noise(points: Encoded, photographs: Tensor, rngs: Sequence[np.random.Generator]) -> NoisyRelease:
    """Return a batch of training: each photograph has noise and t from its own generator, and may lose its release."""
    noise = np.stack([rng.standard_normal((CHANNELS, *points.grid), np.float32) for rng in rngs])
    time = np.array([warp_time(rng.random()) for rng in rngs], np.float32)
    dropped = np.array([rng.random() < DROPPED for rng in rngs])
    present = torch.from_numpy(~dropped).float()
    return NoisyRelease(
        **vars(points) | {"weights": present[points.image], "draft_weights": present},
        photographs=photographs,
        noise=torch.from_numpy(noise),
        time=torch.from_numpy(time),
    )


@torch.inference_mode()
def measure_loss(module: FlowNetwork, batch: NoisyRelease) -> float:
    """Return the training loss of a batch."""
    with autocast(module):
        return float(module(batch.to(module.mean.device)).square().mean())


def autocast(module: FlowNetwork) -> torch.autocast:
    """Return the context of the device's number format."""
    device = module.mean.device
    dtype = pick_dtype(device)
    return torch.autocast(device.type, dtype, enabled=dtype != torch.float32)


@torch.inference_mode()
def sample_images(
    module: FlowNetwork, points: EncodedRelease, count: int, steps: int, guidance: float, rng: np.random.Generator
) -> Tensor:
    """Return samples of the photograph of one release. -> (count, 3, H, W) float32 in [0, 1]

    Deterministic on one machine with a fixed number of threads. Guidance 0 does not read the release.
    """
    device = module.mean.device
    noise = torch.from_numpy(rng.standard_normal((count, CHANNELS, *points.grid), np.float32)).to(device)
    with autocast(module):
        empty = noise.new_zeros(1, module.channels + 2 * CHANNELS, *points.grid)
        condition = module.build_condition(points.to(device)) if guidance > 0 else empty
        velocity = guide(module, condition, guidance)
        cells = solve(velocity, noise, [warp_time(step / steps) for step in range(steps + 1)])
    return module.to_images(cells, points.size).clamp(0, 1)


def guide(module: FlowNetwork, condition: Tensor, guidance: float) -> Velocity:
    """Return the velocity u + guidance (v - u) of the condition (1, C, H/4, W/4). It skips what has weight zero."""

    def predict(given: Tensor, noisy: Tensor, time: float) -> Tensor:
        return module.predict(given.expand(len(noisy), -1, -1, -1), noisy, torch.full((len(noisy),), time, device=noisy.device))

    def velocity(noisy: Tensor, time: float) -> Tensor:
        if guidance == 1:
            return predict(condition, noisy, time)
        prior = predict(torch.zeros_like(condition), noisy, time)
        return prior if guidance == 0 else prior + guidance * (predict(condition, noisy, time) - prior)

    return velocity


def solve(velocity: Velocity, start: Tensor, times: Sequence[float]) -> Tensor:
    """Integrate a velocity from the first to the last time by Heun's method, of second order. The last step is Euler's.

    It ends at the photograph that the network expects at the last but one time. So it removes noise that the network would leave.
    """
    x = start
    for time, after in itertools.pairwise(times):
        slope = velocity(x, time)
        ahead = x + (after - time) * slope
        x = ahead if after == times[-1] else x + (after - time) / 2 * (slope + velocity(ahead, after))
    return x
