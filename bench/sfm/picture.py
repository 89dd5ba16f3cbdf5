"""A drawing of a model: its points and cameras from above."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from bench.sfm.consistency import Doubles
from bench.sfm.incremental_mapping import Model
from bench.types import Floats

SIDE = 480  # pixels
SUPERSAMPLING = 3  # the drawing is this much larger before it is scaled down
SHOWN_FRACTION = 0.9  # of the points, along each axis
POINT, CAMERA, PAPER = (90, 90, 90), (200, 30, 30), (255, 255, 255)


def draw_from_above(model: Model) -> Floats:
    """Return a drawing: points are dots, cameras are wedges that open in the viewing direction. -> (SIDE, SIDE, 3) in [0, 1]

    The vertical is the mean vertical of the images. The mean viewing direction points up on the page.
    """
    axes = _compute_axes(model)
    points, centres = model.points @ axes.T, model.centres @ axes.T  # (P, 2), (V, 2)
    low, high = centres.min(axis=0), centres.max(axis=0)
    if len(points):
        quantiles = np.quantile(points, [(1 - SHOWN_FRACTION) / 2, (1 + SHOWN_FRACTION) / 2], axis=0)
        low, high = np.minimum(low, quantiles[0]), np.maximum(high, quantiles[1])
    size = SUPERSAMPLING * SIDE
    scale = 0.92 * size / max(float((high - low).max()), 1e-9)

    def to_page(rows: Doubles) -> Doubles:
        return (rows - (low + high) / 2) * scale * [1, -1] + size / 2

    paper = Image.new("RGB", (size, size), PAPER)
    pen = ImageDraw.Draw(paper)
    dots = to_page(points)
    for x, y in dots[((dots >= 0) & (dots < size)).all(axis=1)]:
        pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill=POINT)
    length = 0.03 * size
    for pose, centre in zip(model.poses, to_page(centres), strict=True):
        forwards = axes @ pose.rotation.matrix()[2] * [1, -1]
        forwards = forwards / max(float(np.linalg.norm(forwards)), 1e-9)
        side = np.array([-forwards[1], forwards[0]]) * 0.5
        corners = [centre, centre + length * (forwards + side), centre + length * (forwards - side)]
        pen.polygon([tuple(corner) for corner in corners], outline=CAMERA, width=SUPERSAMPLING)
    return np.asarray(paper.resize((SIDE, SIDE), Image.Resampling.LANCZOS), np.float32) / 255.0


def _compute_axes(model: Model) -> Doubles:
    """Return the directions right and forwards on the ground. -> (2, 3)"""
    rotations = np.array([pose.rotation.matrix() for pose in model.poses])  # (V, 3, 3)
    up = -rotations[:, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    forwards = rotations[:, 2].mean(axis=0)
    forwards -= (forwards @ up) * up
    forwards /= np.linalg.norm(forwards)
    return np.stack([np.cross(forwards, up), forwards])
