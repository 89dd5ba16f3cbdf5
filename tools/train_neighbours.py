"""Trains the neighbour model on public photographs, under 10 minutes on one core, and compares it with other predictors.

    .venv/bin/python tools/train_neighbours.py --data DATA --out bench/assets/neighbours.safetensors

Training photographs are those of `train/` that neither `tune.txt` nor `test.txt` lists. The scores are from `tune.txt`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as nnf
from torch import Tensor, nn

from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.images import photographs
from bench.images.photographs import Source
from bench.positions import neighbour_model
from bench.positions.neighbour_model import KIND, NeighbourModel
from bench.registry import spec
from bench.types import Features

NEAR = 12.0  # pixels: keypoints that are closer are neighbours
HIDDEN, RANK, RATE, BATCH, SEED = 384, 128, 2e-3, 2, 0
NOISE = 0.6  # largest standard deviation of the training noise, relative to the descriptor's norm: about that of quantisation


class Model(nn.Module):
    """The model of `bench.positions.neighbour_model` in PyTorch, without the limit on log-ratios."""

    def __init__(self) -> None:
        super().__init__()
        self.hidden, self.out = nn.Linear(128, HIDDEN), nn.Linear(HIDDEN, RANK)
        signs = torch.ones(RANK)
        signs[::2] = -1
        self.scale, self.bias = nn.Parameter(signs / RANK), nn.Parameter(torch.zeros(()))

    def forward(self, descriptors: Tensor) -> Tensor:
        embedded = self.out(nnf.silu(self.hidden(descriptors * 128**0.5)))
        return (embedded * self.scale) @ embedded.T + self.bias


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--photographs", type=int, default=500)
    args = parser.parse_args()
    torch.set_num_threads(1)
    lists = {name: set((args.data / f"{name}.txt").read_text().split()) for name in ("tune", "test")}
    sources = photographs.list_photographs(args.data / "train")
    training = [each for each in sources if each.path.name not in lists["tune"] | lists["test"]][: args.photographs]
    started = time.monotonic()
    secrets = [extract(each) for each in training]
    print(f"{len(secrets)} photographs read in {time.monotonic() - started:.0f} s", flush=True)
    module = fit(secrets, args.steps)
    meta = {
        "extractor": spec.to_json(Sift()),
        "photographs": sorted(each.content_hash() for each in training),
        "near": NEAR,
        "steps": args.steps,
        "batch": BATCH,
        "seed": SEED,
    }
    arrays = {name: tensor_file.to_half(value.detach().numpy()) for name, value in module.state_dict().items()}
    tuning = [extract(each) for each in sources if each.path.name in lists["tune"]]
    model = NeighbourModel(arrays=arrays, meta=meta, digest="")
    meta["validation"] = {"precision_at_10": measure_precision(model, tuning), "chance": measure_chance(tuning)}
    print(meta["validation"], f"{time.monotonic() - started:.0f} s in all")
    print(tensor_file.save(args.out, KIND, arrays, meta))


def extract(source: Source) -> Features:
    """Return the features of a photograph with the settings of the benchmark."""
    return Sift().extract(photographs.read(source.path).pixels)


def fit(secrets: list[Features], steps: int) -> Model:
    """Train by cross-entropy over all pairs of keypoints of a photograph, relative to the photograph's rate of neighbours."""
    torch.manual_seed(SEED)
    module, rng, smooth = Model(), np.random.default_rng(SEED), float("nan")
    optimizer = torch.optim.AdamW(module.parameters(), RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps, pct_start=0.05)
    started = time.monotonic()
    for step in range(steps):
        losses = []
        for number in rng.integers(len(secrets), size=BATCH):
            secret = secrets[number]
            points = torch.from_numpy(secret.keypoints)
            near = ((points[:, None] - points[None]).norm(dim=2) < NEAR).float()
            mask = 1 - torch.eye(len(points))
            rate = ((near * mask).sum() / mask.sum()).clamp(1e-4, 1 - 1e-4)  # a photograph may have no neighbours
            noise = rng.uniform(0, NOISE) * rng.integers(2) * rng.normal(size=secret.descriptors.shape) / 128**0.5
            descriptors = nnf.normalize(torch.from_numpy((secret.descriptors + noise).clip(0).astype(np.float32)), dim=1)
            logits = module(descriptors) + torch.logit(rate)
            loss = nnf.binary_cross_entropy_with_logits(logits, near, mask, reduction="sum") / mask.sum()
            losses.append(loss / (-(rate * rate.log() + (1 - rate) * (1 - rate).log())))  # relative to knowing the rate alone
        value = torch.stack(losses).mean()
        optimizer.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        smooth = float(value) if step == 0 else 0.99 * smooth + 0.01 * float(value)
        if step % 200 == 0:
            print(f"step {step}, relative loss {smooth:.4f}, {time.monotonic() - started:.0f} s", flush=True)
    return module


def measure_precision(model: NeighbourModel, secrets: list[Features], count: int = 10) -> float:
    """Return the fraction of the `count` likeliest neighbours that are nearer than `NEAR`."""
    values = []
    for secret in secrets:
        order, _ = neighbour_model.select_neighbours(model.log_ratios(secret.descriptors[:, None]), count)
        distances = np.linalg.norm(secret.keypoints[order] - secret.keypoints[:, None], axis=2)
        values.append((distances < NEAR).mean())
    return float(np.mean(values))


def measure_chance(secrets: list[Features]) -> float:
    """Return the fraction of all pairs of keypoints that are nearer than `NEAR`."""
    rates = []
    for secret in secrets:
        near = np.linalg.norm(secret.keypoints[:, None] - secret.keypoints[None], axis=2) < NEAR
        rates.append((near.sum() - len(near)) / (near.size - len(near)))
    return float(np.mean(rates))


if __name__ == "__main__":
    main()
