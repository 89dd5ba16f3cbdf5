"""A picture of a model: its points and cameras from above."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from bench.sfm.consistency import Doubles
from bench.sfm.incremental_mapping import Model
from bench.types import Floats

SIDE = 480  # pixels
FINE = 3  # times as large first
SHOWN = 0.9  # share of the points that fit in, along each axis
POINT, CAMERA, PAPER = (90, 90, 90), (200, 30, 30), (255, 255, 255)


def from_above(model: Model) -> Floats:
    """Points as dots, and cameras as wedges that open where they look. -> (SIDE, SIDE, 3) in [0, 1]

    Up is what is up in the images, on average; the middle of the cameras looks up on the page.
    """
    axes = _axes(model)
    points, centres = model.points @ axes.T, model.centres @ axes.T  # (P, 2), (V, 2)
    low, high = np.quantile(points, [(1 - SHOWN) / 2, (1 + SHOWN) / 2], axis=0) if len(points) else (centres[0], centres[0])
    low, high = np.minimum(low, centres.min(axis=0)), np.maximum(high, centres.max(axis=0))
    size = FINE * SIDE
    scale = 0.92 * size / max(float((high - low).max()), 1e-9)

    def placed(rows: Doubles) -> Doubles:
        return (rows - (low + high) / 2) * scale * [1, -1] + size / 2

    paper = Image.new("RGB", (size, size), PAPER)
    pen = ImageDraw.Draw(paper)
    dots = placed(points)
    for x, y in dots[((dots >= 0) & (dots < size)).all(axis=1)]:
        pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill=POINT)
    length = 0.03 * size
    for pose, centre in zip(model.poses, placed(centres), strict=True):
        looks = axes @ pose.rotation.matrix()[2] * [1, -1]
        looks = looks / max(float(np.linalg.norm(looks)), 1e-9)
        side = np.array([-looks[1], looks[0]]) * 0.5
        corners = [centre, centre + length * (looks + side), centre + length * (looks - side)]
        pen.polygon([tuple(corner) for corner in corners], outline=CAMERA, width=FINE)
    return np.asarray(paper.resize((SIDE, SIDE), Image.Resampling.LANCZOS), np.float32) / 255.0


def _axes(model: Model) -> Doubles:
    """Right and forwards on the ground. -> (2, 3)"""
    rotations = np.array([pose.rotation.matrix() for pose in model.poses])  # (V, 3, 3)
    up = -rotations[:, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    forwards = rotations[:, 2].mean(axis=0)
    forwards -= (forwards @ up) * up
    forwards /= np.linalg.norm(forwards)
    return np.stack([np.cross(forwards, up), forwards])
