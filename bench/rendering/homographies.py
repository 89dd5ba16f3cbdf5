"""Pairs of images with a known homography: HPatches, and rendered views of the built-in photographs.

A homography maps the first image's points to the second's: (x', y', w')ᵀ = H (x, y, 1)ᵀ. As everywhere in this project, the
centre of the top-left pixel is (0.5, 0.5).
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from bench.core.errors import UserError
from bench.formats import lists
from bench.images.photographs import Source, crop_square, decode, list_builtin
from bench.images.scene import File, Pixels
from bench.rendering.mipmap import to_linear
from bench.rendering.raster import Doubles
from bench.rendering.sensor import Sensor, expose
from bench.types import Bytes

SEQUENCE = re.compile(r"[iv]_\w+")  # i: the light changes, v: the viewpoint does
SECOND_IMAGES = range(2, 7)  # a sequence has 1.ppm, and these with their homographies
SIDE = 480  # pixels of the rendered views
SENSOR = Sensor(defocus=0.4, shake=0.5, noise=1.0, cast=0.04)
GAIN = 0.8  # the tone curve makes a photograph brighter than it was
GREY = (0.15, 0.15, 0.15)  # beyond the photograph
HALF_PIXEL = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Pair:
    """Two images of one plane."""

    name: str
    first: Pixels
    second: Pixels
    homography: Doubles  # (3, 3) from the first to the second


@dataclass(frozen=True, kw_only=True)
class Warped(Pixels):
    """A built-in photograph under a homography, with its own sensor noise."""

    source: Source
    homography: tuple[float, ...]  # row by row
    seed: int

    def content_hash(self) -> str:
        create_pairs = f"{self.source.content_hash()} {self.homography} {self.seed} {SENSOR}"
        return "sha256:" + hashlib.sha256(create_pairs.encode()).hexdigest()

    def read(self) -> Bytes:
        image = crop_square(decode(self.source.path)[0], SIDE)
        linear = to_linear(image)
        # Rendered at twice the size, so that pixels are averages.
        larger = np.diag([2.0, 2.0, 1.0]) @ np.array(self.homography).reshape(3, 3)
        to_opencv = np.linalg.inv(HALF_PIXEL) @ larger @ HALF_PIXEL
        view = cv2.warpPerspective(linear, to_opencv, (2 * SIDE, 2 * SIDE), borderValue=GREY)
        view = cv2.resize(view, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        return expose(np.asarray(view, np.float32), SENSOR, GAIN, np.random.default_rng([self.seed, 1]))


def create_pairs(seed: int, each: int) -> list[Pair]:
    """Create `each` pairs of every built-in photograph: the photograph's square, and a view of it from another position."""
    pairs = []
    for number, source in enumerate(list_builtin()):
        for index in range(each):
            key = int(np.random.default_rng([seed, number, index]).integers(2**31))
            homography = _draw_homography(np.random.default_rng([key, 0]))
            pairs.append(
                Pair(
                    name=f"{source.name}-{index}",
                    first=Warped(source=source, homography=tuple(np.eye(3).ravel().tolist()), seed=key + 1),
                    second=Warped(source=source, homography=tuple(homography.ravel().tolist()), seed=key),
                    homography=homography,
                )
            )
    return pairs


def _draw_homography(rng: np.random.Generator) -> Doubles:
    """Draw a homography: rotation, zoom and shift, then each corner moves by up to an eighth of the side. -> (3, 3)"""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * float(SIDE)
    turn, zoom = rng.normal(0, 0.12), np.exp(rng.normal(0, 0.18))
    c, s = np.cos(turn), np.sin(turn)
    moved = (corners - SIDE / 2) @ (zoom * np.array([[c, s], [-s, c]])) + SIDE / 2 + rng.normal(0, 0.04, 2) * SIDE
    moved += rng.uniform(-0.125, 0.125, (4, 2)) * SIDE
    return np.asarray(cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32)), np.float64)


def load_hpatches(root: Path) -> list[Pair]:
    """Read HPatches' sequences (Balntas et al., CVPR 2017): folders i_* and v_* with 1.ppm to 6.ppm and H_1_2 to H_1_6.

    Its homographies put the centre of the top-left pixel at (0, 0), and are converted.

    Raises
    ------
    UserError
        naming file and line, if something is missing or damaged.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    sequences = sorted(path for path in root.iterdir() if path.is_dir() and SEQUENCE.fullmatch(path.name))
    if not sequences:
        raise UserError(f"{root}: no sequence of HPatches in it (folders i_* and v_*)")
    return [
        Pair(
            name=f"{sequence.name}-{other}",
            first=_open_image(sequence / "1.ppm"),
            second=_open_image(sequence / f"{other}.ppm"),
            homography=_read_homography(sequence / f"H_1_{other}"),
        )
        for sequence in sequences
        for other in SECOND_IMAGES
    ]


def _open_image(path: Path) -> File:
    try:
        with Image.open(path) as opened:
            return File(path=path, size=opened.size)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except UnidentifiedImageError:
        raise UserError(f"{path}: not an image") from None


def _read_homography(path: Path) -> Doubles:
    """Read a homography. -> (3, 3), with a last element of one"""
    rows: list[np.ndarray] = []
    for line, fields in lists.read_fields(path):
        where = f"{path}:{line}"
        if len(fields) != 3 or len(rows) == 3:
            raise UserError(f"{where}: a homography has three lines of three numbers")
        rows.append(lists.parse_numbers(fields, where))
    if len(rows) != 3:
        raise UserError(f"{path}: a homography has three lines of three numbers, but there are {len(rows)}")
    moved = HALF_PIXEL @ np.stack(rows) @ np.linalg.inv(HALF_PIXEL)
    if np.linalg.cond(moved) > 1e12:
        raise UserError(f"{path}: this matrix has no inverse")
    return moved / moved[2, 2]
