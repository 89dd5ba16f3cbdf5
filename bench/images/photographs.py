"""Photographs as every plugin sees them: 256 x 256 RGB, by one rule.

The rule: EXIF rotation is applied; transparency is laid over white; one channel is repeated three times; 16 bits are scaled to 8;
the largest centred square is cut out and resized to 256 x 256 with Pillow's bicubic filter, which averages when it shrinks.
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
SMALLEST = 32  # pixels; less cannot be called a photograph
MEGADEPTH = re.compile(r"dense\d+")  # the folder of a reconstruction, which has one called imgs
SUFFIXES = {".jpg", ".jpeg", ".png", ".ppm", ".webp"}


@dataclass(frozen=True)
class Source:
    """A photograph that has not been read yet."""

    name: str
    path: Path

    def content_hash(self) -> str:
        return "sha256:" + hashlib.sha256(self.path.read_bytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class Photograph:
    """(256, 256, 3) uint8 RGB, and what had to be done to it that a reader should know."""

    pixels: Bytes
    notes: tuple[str, ...] = ()


def folder(directory: Path) -> list[Source]:
    """The JPEG, PNG, PPM and WebP files of a folder and its subfolders, by name.

    Of MegaDepth (Li and Snavely, CVPR 2018), those in `dense*/imgs`; other pictures lie beside them. Of HPatches (Balntas et al.,
    CVPR 2017), all six of each sequence.

    Raises
    ------
    UserError
        if it is no folder, or holds no photograph.
    """
    if not directory.is_dir():
        raise UserError(f"--images {directory}: no such folder")
    files = sorted(path for path in directory.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    files = [path for path in files if path.parent.name == "imgs" and MEGADEPTH.fullmatch(path.parents[1].name)] or files
    if not files:
        raise UserError(f"--images {directory}: no photograph in it (looked for {', '.join(sorted(SUFFIXES))})")
    return [Source(path.relative_to(directory).as_posix(), path) for path in files]


def held_out(sources: list[Source], chosen: Path | None) -> tuple[list[Source], list[Source]]:
    """Part photographs into those to train on and those to validate on.

    `chosen` is a folder of others, or a text file with the names of those of `sources` to hold out, one a line; None holds out
    every twentieth.

    Raises
    ------
    UserError
        if `chosen` does not exist, or names none of them.
    """
    if chosen is not None and chosen.is_dir():
        return sources, folder(chosen)
    if chosen is None:
        names = {source.name for source in sources[::20]}
    elif chosen.is_file():
        names = set(chosen.read_text(encoding="utf-8").split("\n"))
    else:
        raise UserError(f"{chosen}: no such folder or file")
    validation = [source for source in sources if source.name in names]
    if not validation:
        raise UserError(f"{chosen}: names none of the photographs")
    return [source for source in sources if source.name not in names], validation


def builtin() -> list[Source]:
    """The seven colour photographs that scikit-image and scikit-learn carry in their wheels."""
    names = ("astronaut.png", "chelsea.png", "coffee.png", "rocket.jpg", "motorcycle_left.png")
    return [*_of_scikit_image(*names), *_of_scikit_learn("china.jpg", "flower.jpg")]


def of_things() -> list[Source]:
    """Pictures that the libraries' wheels carry and that show nobody."""
    first = ("chelsea.png", "coffee.png", "rocket.jpg", "motorcycle_left.png", "coins.png", "hubble_deep_field.jpg")
    others = ("ihc.png", "moon.png", "page.png", "retina.jpg", "text.png", "logo.png")
    return [*_of_scikit_image(*first, *others), *_of_scikit_learn("china.jpg", "flower.jpg")]


def of_grounds() -> list[Source]:
    """Grass, gravel and bricks, as scikit-image's wheel carries them."""
    return _of_scikit_image("grass.png", "gravel.png", "brick.png")


def of_people() -> list[Source]:
    """Three people, as scikit-image's and matplotlib's wheels carry them: the astronaut, the cameraman, the admiral."""
    admiral = _carried("matplotlib", "mpl-data/sample_data", "grace_hopper.jpg")
    return [*_of_scikit_image("astronaut.png", "camera.png"), *admiral]


def _of_scikit_image(*names: str) -> list[Source]:
    return _carried("skimage", "data", *names)


def _of_scikit_learn(*names: str) -> list[Source]:
    return _carried("sklearn", "datasets/images", *names)


def _carried(package: str, directory: str, *names: str) -> list[Source]:
    """Files of a package that is not imported for them: that would take seconds."""
    spec = importlib.util.find_spec(package)
    assert spec is not None
    assert spec.origin is not None
    return [Source(path.stem, path) for path in (Path(spec.origin).parent / directory / name for name in names)]


def read(path: Path) -> Photograph:
    """Read one photograph by the module's rule.

    Raises
    ------
    UnitError
        if the file cannot be decoded, or is smaller than 32 pixels on a side.
    """
    image, notes = decode(path)
    return Photograph(square(image, SIDE), notes)


def decode(path: Path, upright: bool = True) -> tuple[Image.Image, tuple[str, ...]]:
    """Return an 8-bit RGB image of the file's own size, and notes on what was converted. `upright` applies EXIF rotation."""
    try:
        with Image.open(path) as opened:
            opened.load()
            image = ImageOps.exif_transpose(opened) if upright else opened
    except Image.DecompressionBombError as error:
        raise SampleError(f"{path.name}: too many pixels to be read safely ({error})") from error
    except (OSError, SyntaxError, ValueError) as error:
        # Pillow says "image file is truncated", "cannot identify image file", ...
        raise SampleError(f"{path.name}: cannot be read as an image: {error}") from error
    if min(image.size) < SMALLEST:
        raise SampleError(f"{path.name}: {image.width} x {image.height} pixels; at least {SMALLEST} x {SMALLEST} are needed")
    notes = []
    if image.mode.startswith("I") or image.mode == "F":
        notes.append(f"{path.name}: 16 bits a channel, scaled to 8")
        deep = np.asarray(image, dtype=np.float64)
        image = Image.fromarray(np.clip(np.rint(deep / 257.0), 0, 255).astype(np.uint8))
    if "A" in image.getbands() or "transparency" in image.info:
        notes.append(f"{path.name}: transparency, laid over white")
        rgba = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba)
    if image.mode in ("L", "LA", "1"):
        notes.append(f"{path.name}: grey, its one channel serves as red, green and blue")
    return image.convert("RGB"), tuple(notes)


def square(image: Image.Image, side: int) -> Bytes:
    """Cut out the largest centred square and resize it. -> (side, side, 3) uint8"""
    short = min(image.size)
    left, top = (image.width - short) // 2, (image.height - short) // 2
    box = (left, top, left + short, top + short)
    return np.array(image.crop(box).resize((side, side), Image.Resampling.BICUBIC))
