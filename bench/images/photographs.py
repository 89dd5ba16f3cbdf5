"""Photographs as 256 x 256 RGB images, all converted by one rule.

The rule: EXIF rotation is applied. Transparency is composited over white. A single channel is repeated three times. 16 bits are
scaled to 8. The largest centred square is cropped and resized with Pillow's bicubic filter, which averages if it shrinks.
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from bench.core.errors import SampleError, UserError
from bench.types import Bytes

SIDE = 256  # pixels
MIN_SIDE = 32  # pixels
MEGADEPTH = re.compile(r"dense\d+")  # the folder of a reconstruction; its subfolder `imgs` holds the photographs
SUFFIXES = {".jpg", ".jpeg", ".png", ".ppm", ".webp"}


@dataclass(frozen=True)
class Source:
    """A photograph on disk, not yet read."""

    name: str
    path: Path

    def content_hash(self) -> str:
        return "sha256:" + hashlib.sha256(self.path.read_bytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph as (256, 256, 3) uint8 RGB, with notes on its conversion."""

    pixels: Bytes
    notes: tuple[str, ...] = ()


def list_photographs(directory: Path) -> list[Source]:
    """Return the JPEG, PNG, PPM and WebP files of a folder and its subfolders, sorted by path.

    In MegaDepth (Li and Snavely, CVPR 2018), only files in `dense*/imgs` are photographs. In HPatches (Balntas et al., CVPR
    2017), all six files of each sequence are.

    Raises
    ------
    UserError
        if there is no such folder, or no photograph in it.
    """
    if not directory.is_dir():
        raise UserError(f"--images {directory}: no such folder")
    files = sorted(path for path in directory.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    files = [path for path in files if path.parent.name == "imgs" and MEGADEPTH.fullmatch(path.parents[1].name)] or files
    if not files:
        raise UserError(f"--images {directory}: no photograph in it (looked for {', '.join(sorted(SUFFIXES))})")
    return [Source(path.relative_to(directory).as_posix(), path) for path in files]


def split_validation(sources: list[Source], selection: Path | None) -> tuple[list[Source], list[Source]]:
    """Return photographs split into a training set and a validation set.

    `selection` is a folder of other photographs for validation, or a text file with the names of the validation photographs, one
    per line. For None, every twentieth photograph is for validation.

    Raises
    ------
    UserError
        if `selection` does not exist, or contains the name of no photograph.
    """
    if selection is not None and selection.is_dir():
        return sources, list_photographs(selection)
    if selection is None:
        names = {source.name for source in sources[::20]}
    elif selection.is_file():
        names = set(selection.read_text(encoding="utf-8").split("\n"))
    else:
        raise UserError(f"{selection}: no such folder or file")
    validation = [source for source in sources if source.name in names]
    if not validation:
        raise UserError(f"{selection}: names none of the photographs; write one name per line, relative to --images")
    return [source for source in sources if source.name not in names], validation


def list_builtin() -> list[Source]:
    """Return seven colour photographs from the wheels of scikit-image and scikit-learn."""
    names = ("astronaut.png", "chelsea.png", "coffee.png", "rocket.jpg", "motorcycle_left.png")
    return [*_find_in_scikit_image(*names), *_find_in_scikit_learn("china.jpg", "flower.jpg")]


def list_objects() -> list[Source]:
    """Return pictures without people from the wheels of scikit-image and scikit-learn."""
    photographs = ("chelsea.png", "coffee.png", "rocket.jpg", "motorcycle_left.png", "coins.png", "hubble_deep_field.jpg")
    other_pictures = ("ihc.png", "moon.png", "page.png", "retina.jpg", "text.png", "logo.png")
    return [*_find_in_scikit_image(*photographs, *other_pictures), *_find_in_scikit_learn("china.jpg", "flower.jpg")]


def list_ground_textures() -> list[Source]:
    """Return pictures of grass, gravel and bricks from the wheel of scikit-image."""
    return _find_in_scikit_image("grass.png", "gravel.png", "brick.png")


def list_people() -> list[Source]:
    """Return three pictures of people from the wheels of scikit-image and matplotlib: astronaut, cameraman, admiral."""
    admiral = _find_in_package("matplotlib", "mpl-data/sample_data", "grace_hopper.jpg")
    return [*_find_in_scikit_image("astronaut.png", "camera.png"), *admiral]


def _find_in_scikit_image(*names: str) -> list[Source]:
    return _find_in_package("skimage", "data", *names)


def _find_in_scikit_learn(*names: str) -> list[Source]:
    return _find_in_package("sklearn", "datasets/images", *names)


def _find_in_package(package: str, directory: str, *names: str) -> list[Source]:
    """Return data files of a package without importing it, which would take seconds."""
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    return [Source(path.stem, path) for path in (Path(spec.origin).parent / directory / name for name in names)]


def read(path: Path) -> Photograph:
    """Read one photograph by the rule of this module.

    Raises
    ------
    SampleError
        if the file cannot be decoded, or is smaller than 32 pixels on a side.
    """
    image, notes = decode(path)
    return Photograph(crop_square(image, SIDE), notes)


def decode(path: Path, upright: bool = True) -> tuple[Image.Image, tuple[str, ...]]:
    """Return an 8-bit RGB image in the size of the file, and notes on its conversion. `upright` applies EXIF rotation."""
    try:
        with Image.open(path) as opened:
            opened.load()
            image = ImageOps.exif_transpose(opened) if upright else opened
    except Image.DecompressionBombError as error:
        raise SampleError(f"{path.name}: too many pixels to read safely ({error})") from error
    except (OSError, SyntaxError, ValueError) as error:
        # Messages of Pillow: "image file is truncated", "cannot identify image file", ...
        raise SampleError(f"{path.name}: cannot be read as an image: {error}") from error
    if min(image.size) < MIN_SIDE:
        raise SampleError(f"{path.name}: {image.width} x {image.height} pixels; at least {MIN_SIDE} x {MIN_SIDE} are needed")
    notes = []
    if image.mode.startswith("I") or image.mode == "F":
        notes.append(f"{path.name}: 16 bits a channel, scaled to 8")
        deep = np.asarray(image, dtype=np.float64)
        image = Image.fromarray(np.clip(np.rint(deep / 257.0), 0, 255).astype(np.uint8))
    if "A" in image.getbands() or "transparency" in image.info:
        notes.append(f"{path.name}: transparency, composited over white")
        rgba = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba)
    if image.mode in ("L", "LA", "1"):
        notes.append(f"{path.name}: grey, its channel is used as red, green and blue")
    return image.convert("RGB"), tuple(notes)


def crop_square(image: Image.Image, side: int) -> Bytes:
    """Crop the largest centred square and resize it. -> (side, side, 3) uint8"""
    short = min(image.size)
    left, top = (image.width - short) // 2, (image.height - short) // 2
    box = (left, top, left + short, top + short)
    return np.array(image.crop(box).resize((side, side), Image.Resampling.BICUBIC))
