"""SIFT through OpenCV, upright by default (Lowe, IJCV 2004)."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace

import numpy as np

from bench.api import Extractor
from bench.core.errors import SampleError, UserError
from bench.geometry.nearest_words import unit_rows
from bench.images.photographs import Source
from bench.types import Features, Indices


@dataclass(frozen=True, kw_only=True)
class Sift(Extractor):
    """SIFT; upright by default: one orientation, that of gravity, and each point once.

    The orientation is never released. An upright descriptor reveals the direction of its edges. With an oriented descriptor
    (`upright=false`, as in the paper) the attacker must infer the direction.
    """

    exact_zeros = True
    eight_bit = True

    upright: bool = True
    contrast_threshold: float = 0.002  # lower than OpenCV's .04: about 600 to 1,000 keypoints for 256 x 256 pixels
    edge_threshold: float = 15.0
    max_keypoints: int = 1000  # the keypoints with the strongest response

    def __post_init__(self) -> None:
        if self.contrast_threshold < 0 or self.edge_threshold <= 0 or self.max_keypoints < 1:
            raise UserError("sift: thresholds must be positive and max_keypoints at least 1")

    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        import cv2

        sift = cv2.SIFT_create(  # type: ignore[attr-defined]
            contrastThreshold=self.contrast_threshold, edgeThreshold=self.edge_threshold, enable_precise_upscale=True
        )
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        points = sift.detect(grey, None)
        if self.upright:
            points = _deduplicate(points)
        # Strongest first, equal responses by position, so that the selection is reproducible.
        points = sorted(points, key=lambda p: (-p.response, p.pt, p.size, p.angle))[: self.max_keypoints]
        if not points:
            raise SampleError("no keypoint was found: is the image flat?")
        points, values = sift.compute(grey, points)
        codes = values.astype(np.uint8)  # OpenCV rounds to 0..255 and returns float32
        xy = np.array([point.pt for point in points], dtype=np.float32) + 0.5  # OpenCV puts the centre of the first pixel at 0
        frames = np.array([(point.size, math.radians(point.angle)) for point in points], dtype=np.float32)  # (N, 2)
        keep = codes.any(axis=1)
        height, width = grey.shape
        features = Features(
            keypoints=xy[keep], descriptors=unit_rows(codes[keep]), codes=codes[keep], size=(width, height), frames=frames[keep]
        )
        return features.by_position()

    def mirror_order(self) -> Indices:
        """Return the permutation for the mirrored photograph.

        Upright: the columns of the 4 x 4 histograms are reversed, and angle a becomes π - a. Oriented: the rows are reversed, and
        a becomes -a.
        """
        row, column, angle = np.indices((4, 4, 8))
        if self.upright:
            column, angle = 3 - column, (4 - angle) % 8
        else:  # the frame turns with the photograph
            row, angle = 3 - row, -angle % 8
        order: Indices = ((row * 4 + column) * 8 + angle).ravel()
        return order

    def turn_order(self) -> Indices:
        """Return the permutation for the photograph turned by 90 degrees counter-clockwise.

        Upright: the columns of the histograms become rows from below, and angle a becomes a + π / 2. Oriented: unchanged.
        """
        row, column, angle = np.indices((4, 4, 8))
        if self.upright:
            row, column, angle = column, 3 - row, (angle - 2) % 8
        order: Indices = ((row * 4 + column) * 8 + angle).ravel()
        return order

    def without_limit(self) -> Extractor:
        return replace(self, max_keypoints=sys.maxsize)


def _deduplicate(points: list) -> list:
    """Return one of the points that differ in orientation only, and set all orientations to 0."""
    unique = {(point.pt, point.size): point for point in points}
    for point in unique.values():
        point.angle = 0.0
    return list(unique.values())


PLUGIN = Sift
