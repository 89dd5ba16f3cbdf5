"""Training data for attackers of word sets: random crops and random releases of their words, assembled on the device.

A batch takes milliseconds on a GPU. All views, dictionaries and nearest words stay on the device: about 1.5 GB for 800
photographs. Words other than the true one are drawn independently. At 8,000 words or more, two of a set are equal in fewer than
one of a thousand sets.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor

from bench.codebook.clustered import cluster_words
from bench.codebook.public import Public
from bench.context.encoding import log_odds
from bench.context.network import KeypointGraph
from bench.context.train import Example
from bench.core.errors import SampleError
from bench.core.progress import Progress
from bench.extractors.sift import Sift
from bench.identification.thumbnails import Doubles
from bench.images.photographs import SIDE, Source, crop_square, decode
from bench.images.views import PhotographView
from bench.inversion.data import check_dictionary_sizes, quantise
from bench.inversion.encoding import CELL, EncodedRelease
from bench.inversion.symmetry import find_symmetries
from bench.mechanisms.subset import log10_chance
from bench.settings import Asset
from bench.types import Indices

SIDES = (256, 272, 288, 320)  # pixels
MOST_KEYPOINTS = 1000  # of 256 x 256 pixels
HALF, CLUSTERED = 2, 32  # a dictionary has so many times the words of its smaller versions
SYMMETRIES = find_symmetries(Sift())


@dataclass(frozen=True, eq=False)
class Views:
    """V views of photographs, with T keypoints in all."""

    pixels: tuple[Tensor, ...]  # of each view, (S, S, 3) uint8
    keypoints: Tensor  # (T, 2) float32, in pixels
    codes: Tensor  # (T, D) uint8
    starts: Tensor  # (V,) int64, index of the first keypoint
    counts: Tensor  # (V,) int64


@dataclass(frozen=True, eq=False)
class Words:
    """The nearest words of all keypoints, each in the dictionary of its photograph. All dictionaries have K words."""

    table: Tensor  # (rows, D) uint8, the dictionaries, stacked
    size: int  # K; the table may hold more words of each dictionary
    first: Tensor  # (V,) int64, row of the first word of the dictionary of a view
    nearest: Tensor  # (T,) int64, row of the nearest word of a keypoint


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Views, and their words in the whole dictionaries, in the first half of each, and in clustered ones."""

    views: Views
    words: tuple[Words, Words, Words]


@dataclass(frozen=True, eq=False)
class Crops:
    """The random choices of a batch of B crops."""

    views: Indices  # (B,)
    corners: Indices  # (B, 2) left and top, in pixels
    symmetries: Indices  # (B,) index in SYMMETRIES


@dataclass(frozen=True, eq=False)
class Batch:
    """B crops under symmetries and their releases, with P keypoints in all."""

    photographs: Tensor  # (B, 3, 256, 256) in [0, 1]
    example: Example
    keypoints: Tensor  # (P, 2) float32, in pixels
    image: Tensor  # (P,) int64, index in the batch


# ---- preparation


def collect_training_views(sources: Sequence[Source], sides: Sequence[int] = SIDES) -> list[PhotographView]:
    """Return the centred square of each photograph at each side. An unreadable photograph is reported on stderr and skipped."""
    views = []
    with Progress("features", len(sources)) as progress:
        for source in sources:
            try:
                image, _ = decode(source)
                for side in sides:
                    pixels = crop_square(image, side)
                    extractor = Sift(max_keypoints=int(MOST_KEYPOINTS * (side / SIDE) ** 2))
                    views.append(PhotographView(source.content_hash(), pixels, extractor.extract(pixels)))
            except SampleError as error:
                progress.log(f"skipped: {error}")
            progress.advance()
    return views


def stack_views(views: Sequence[PhotographView], device: torch.device) -> Views:
    """Stack views as tensors."""
    counts = torch.tensor([len(view.features) for view in views])
    codes = np.concatenate([view.features.codes for view in views if view.features.codes is not None])
    return Views(
        pixels=tuple(torch.from_numpy(view.pixels).to(device) for view in views),
        keypoints=torch.from_numpy(np.concatenate([view.features.keypoints for view in views])).to(device),
        codes=torch.from_numpy(codes).to(device),
        starts=(counts.cumsum(0) - counts).to(device),
        counts=counts.to(device),
    )


def find_words(
    views: Sequence[PhotographView], assigned: Mapping[str, Asset], public: Public, device: torch.device
) -> tuple[Words, Words, Words]:
    """Find the words of all keypoints in the dictionaries assigned to their photographs. -> the words of `TrainingData`"""
    assets = sorted(set(assigned.values()))
    check_dictionary_sizes(set(assets), [0], public)
    size = len(public.dictionary(assets[0]))
    whole, half = _look_up(views, assigned, [0, size // HALF], public, device)
    clustered = {f"{asset}, clustered": cluster_words(public.dictionary(asset), size // CLUSTERED) for asset in assets}
    renamed = {photograph: Asset(f"{asset}, clustered") for photograph, asset in assigned.items()}
    return whole, half, _look_up(views, renamed, [0], Public(dictionaries=clustered), device)[0]


def _look_up(
    views: Sequence[PhotographView], assigned: Mapping[str, Asset], sizes: Sequence[int], public: Public, device: torch.device
) -> list[Words]:
    """Find the words of all keypoints at several sizes of the dictionaries, the whole (0) first."""
    assets = sorted(set(assigned.values()))
    table = torch.from_numpy(np.concatenate([public.dictionary(asset).words for asset in assets])).to(device)
    rows = {asset: number * len(public.dictionary(asset)) for number, asset in enumerate(assets)}
    quantisation = quantise(views, assigned, sizes, public)
    first = torch.tensor([rows[assigned[view.photograph]] for view in views], device=device)
    found = []
    for size in sizes:
        nearest = []
        for view in views:
            asset = assigned[view.photograph]
            nearest.append(quantisation(public.dictionary(asset, size), view.features.exact) + rows[asset])
        used = size or len(table) // len(assets)
        found.append(Words(table, used, first, torch.from_numpy(np.concatenate(nearest)).to(device)))
    return found


def measure_errors(views: Views, words: Words) -> list[float]:
    """Return the mean distance of unit descriptors from their words for each dictionary, over views of 256 x 256 pixels."""
    errors = []
    for first in words.first.unique():
        parts = [
            torch.arange(int(start), int(start + count), device=first.device)
            for pixels, start, count, row in zip(views.pixels, views.starts, views.counts, words.first, strict=True)
            if len(pixels) == SIDE and row == first
        ]
        rows = torch.cat(parts)
        distances = (scale_rows(words.table[words.nearest[rows]]) - scale_rows(views.codes[rows])).norm(dim=1)
        errors.append(float(distances.mean()))
    return errors


# ---- batches, on the device


def draw_crops(views: Views, batch: int, rng: np.random.Generator) -> Crops:
    """Draw views, windows of 256 x 256 pixels and symmetries, all uniformly."""
    numbers = rng.integers(len(views.pixels), size=batch)
    room = np.array([[len(views.pixels[number]) - SIDE] for number in numbers])
    return Crops(numbers, rng.integers(room + 1, size=(batch, 2)), rng.integers(len(SYMMETRIES), size=batch))


def assemble(
    views: Views, words: Words, crops: Crops, epsilons: Doubles, size: int, neighbours: int, rng: np.random.Generator
) -> Batch:
    """Return crops and a random release of each.

    Parameters
    ----------
    epsilons : (B,) of each crop; infinity always releases the true word
    size : m, words released per keypoint
    neighbours : k, of the graph
    """
    device = views.keypoints.device
    numbers, symmetries = torch.from_numpy(crops.views).to(device), torch.from_numpy(crops.symmetries).to(device)
    rows, keypoints, inside = cut_keypoints(views, numbers, torch.from_numpy(crops.corners).to(device))  # (B, N)
    keypoints = transform_keypoints(keypoints, symmetries)
    image = inside.nonzero()[:, 0]  # (P,)
    order = _stack_orders(device)[symmetries[image]]  # (P, D)
    true = words.nearest[rows[inside]]  # (P,)
    log10_true = [log10_chance(float(epsilon), words.size, size) for epsilon in epsilons]
    chances = torch.tensor([10**value for value in log10_true], device=device)
    odds = torch.tensor([log_odds(value, size) for value in log10_true], device=device)  # (B,)
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    released = torch.rand(len(true), device=device, generator=generator) < chances[image]
    column = torch.randint(size, (len(true),), device=device, generator=generator)
    drawn = torch.randint(words.size, (len(true), size), device=device, generator=generator)
    drawn = drawn + words.first[numbers[image], None]
    index = torch.arange(len(true), device=device)
    drawn[index, column] = torch.where(released, true, drawn[index, column])
    candidates = scale_rows(words.table[drawn]).gather(2, order[:, None].expand(-1, size, -1))  # (P, m, D)
    labels = torch.where(released, column, size)
    graph = build_graph(candidates, odds[image], keypoints, inside, neighbours)
    descriptors = scale_rows(views.codes[rows[inside]]).gather(1, order)
    pixels = [
        transform_crop(views.pixels[view][top : top + SIDE, left : left + SIDE], symmetry)
        for view, (left, top), symmetry in zip(crops.views, crops.corners, crops.symmetries, strict=True)
    ]
    photographs = torch.stack(pixels).permute(0, 3, 1, 2).float() / 255
    return Batch(photographs, Example(graph, labels, descriptors), keypoints[inside], image)


def cut_keypoints(views: Views, numbers: Tensor, corners: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the keypoints inside crops, padded to the greatest number N.

    (B,), (B, 2) -> their indices (B, N), their pixels in the crop (B, N, 2), and whether they exist (B, N)
    """
    counts = views.counts[numbers]
    steps = torch.arange(int(counts.max()), device=counts.device)
    exists = steps < counts[:, None]
    rows = (views.starts[numbers, None] + steps).clamp_max(len(views.keypoints) - 1)
    keypoints = views.keypoints[rows] - corners[:, None].float()
    inside = exists & ((keypoints >= 0) & (keypoints < SIDE)).all(dim=2)
    order = torch.argsort((~inside).to(torch.int8), dim=1, stable=True)[:, : int(inside.sum(dim=1).max())]
    return rows.gather(1, order), keypoints.gather(1, order[:, :, None].expand(-1, -1, 2)), inside.gather(1, order)


def transform_keypoints(keypoints: Tensor, symmetries: Tensor) -> Tensor:
    """Transform the keypoints of each crop by its symmetry. (B, N, 2), (B,) -> (B, N, 2)"""
    mirrored = torch.tensor([symmetry.mirrored for symmetry in SYMMETRIES], device=keypoints.device)[symmetries, None]
    turns = torch.tensor([symmetry.turns for symmetry in SYMMETRIES], device=keypoints.device)[symmetries, None]
    x, y = keypoints.unbind(dim=2)  # (B, N)
    x = torch.where(mirrored, SIDE - x, x)
    for turn in range(1, 4):
        x, y = torch.where(turns >= turn, y, x), torch.where(turns >= turn, SIDE - x, y)
    return torch.stack([x, y], dim=2)


def transform_crop(pixels: Tensor, symmetry: int) -> Tensor:
    """Transform a crop by a symmetry. (256, 256, 3) -> (256, 256, 3)"""
    chosen = SYMMETRIES[symmetry]
    return (pixels.flip(1) if chosen.mirrored else pixels).rot90(chosen.turns)


def _stack_orders(device: torch.device) -> Tensor:
    """Return the permutations of a descriptor's components. -> (8, D)"""
    orders = [symmetry.order for symmetry in SYMMETRIES]
    length = next(len(order) for order in orders if order is not None)
    identity = np.arange(length)
    return torch.from_numpy(np.stack([identity if order is None else order for order in orders])).to(device)


def scale_rows(codes: Tensor) -> Tensor:
    """Return rows scaled to unit norm. (..., D) uint8 -> (..., D) float32"""
    return nnf.normalize(codes.float(), dim=-1)


def build_graph(candidates: Tensor, odds: Tensor, keypoints: Tensor, inside: Tensor, neighbours: int) -> KeypointGraph:
    """Return the graph of a batch, as `bench.context.encoding.build_graph` does on the CPU.

    (P, m, D), (P,), and padded (B, N, 2), (B, N)
    """
    batch, most, _ = keypoints.shape
    available = min(neighbours, most - 1)
    distances = torch.cdist(keypoints, keypoints, compute_mode="donot_use_mm_for_euclid_dist")  # (B, N, N)
    distances = distances.masked_fill(~inside[:, None], math.inf)
    distances.diagonal(dim1=1, dim2=2).fill_(math.inf)
    lengths, near = distances.topk(available, dim=2, largest=False)  # (B, N, k)
    lengths, near = nnf.pad(lengths, (0, neighbours - available), value=math.inf), nnf.pad(near, (0, neighbours - available))
    present = lengths < math.inf
    flat = near.flatten(1)  # (B, N k)
    offsets = keypoints.gather(1, flat[:, :, None].expand(-1, -1, 2)).view(batch, most, neighbours, 2) - keypoints[:, :, None]
    offsets = offsets * present[:, :, :, None]
    # The edge back from a neighbour: the column in which its own list of neighbours holds the keypoint.
    lists = near.gather(1, flat[:, :, None].expand(-1, -1, neighbours)).view(batch, most, neighbours, neighbours)
    listed = present.gather(1, flat[:, :, None].expand(-1, -1, neighbours)).view(batch, most, neighbours, neighbours)
    back = (lists == torch.arange(most, device=near.device)[:, None, None]) & listed
    mutual = back.any(dim=3) & present
    numbers = (inside.flatten().cumsum(0) - 1).view(batch, most)  # index of a keypoint among all P
    indices = numbers.gather(1, flat).view(batch, most, neighbours).clamp_min(0)
    count = len(candidates)
    reverse = torch.where(mutual, indices * neighbours + back.to(torch.int8).argmax(dim=3), count * neighbours)
    return KeypointGraph(
        candidates=candidates,
        odds=odds,
        positions=2 * keypoints[inside] / SIDE - 1,
        spacing=torch.log1p(offsets.norm(dim=3).amax(dim=2))[inside],
        neighbours=indices[inside],
        offsets=offsets[inside],
        present=present[inside].float(),
        reverse=reverse[inside],
    )


def encode_batch(batch: Batch, logs: Tensor) -> EncodedRelease:
    """Encode a batch with the log posteriors (P, m + 1) of its candidates, as `bench.context.reconstruct` does."""
    candidates, odds = batch.example.graph.candidates, batch.example.graph.odds
    count, size, length = candidates.shape
    position = batch.keypoints.clamp(0, SIDE * (1 - 1e-6)) / CELL
    within = position - position.floor() - 0.5
    defense = torch.stack([odds, torch.full_like(odds, size)], dim=1) / 4
    values = torch.cat([candidates.view(count, size * length) * length**0.5, within, logs, defense], dim=1)
    return EncodedRelease(values=values, coordinates=position, image=batch.image, batch=len(batch.photographs), size=(SIDE, SIDE))
