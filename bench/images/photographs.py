"""Photographs as 256 x 256 RGB images, all converted by one rule.

The rule: EXIF rotation is applied. Transparency is composited over white. A single channel is repeated three times. 16 bits are
scaled to 8. The first page of a TIFF file is read. The largest centred square is cropped and resized with Pillow's bicubic
filter, which averages if it shrinks. JPEG files of more than 2²⁶ pixels (8192 x 8192) are decoded at half their width and height,
which bounds the memory: 3 bytes a pixel and several copies.
"""

from __future__ import annotations

import hashlib
import importlib.util
import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from bench.core.errors import SampleError, UserError
from bench.images import torchvision_datasets
from bench.types import Bytes

SIDE = 256  # pixels
MIN_SIDE = 32  # pixels
MAX_WHOLE = 2**26  # pixels: greater JPEG files are decoded at half size
MEGADEPTH = re.compile(r"dense\d+")  # the folder of a reconstruction; its subfolder `imgs` holds the photographs
DEEPEST = 65535  # the greatest value of 16 bits
SUFFIXES = {".avif", ".bmp", ".jfif", ".jpeg", ".jpg", ".png", ".ppm", ".tif", ".tiff", ".webp"}
# Formats of photographs that are not read: HEIF, raw files of cameras, JPEG 2000, JPEG XL, and others.
UNREAD = {
    *(".heic", ".heif", ".hif", ".jp2", ".j2k", ".jxl", ".jpe", ".gif", ".pgm", ".pnm", ".tga", ".psd", ".exr", ".hdr"),
    *(".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".raw", ".rw2"),
}
RESOURCE_FORK = "._"  # begins the names of files that macOS writes beside others on foreign disks
NAMED = 3  # files of each kind that a message names
# EXIF orientation -> the transposition that makes the picture upright (Exif 2.32, table 6).
UPRIGHT: Mapping[int, Image.Transpose] = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
INVERSE = {6: 8, 8: 6}  # all other transpositions are their own inverses


@dataclass(frozen=True)
class Source:
    """A photograph on disk, not yet read."""

    name: str
    path: Path

    def content_hash(self) -> str:
        return "sha256:" + hashlib.sha256(self.path.read_bytes()).hexdigest()

    def open(self) -> Image.Image:
        """Return the image, whose pixels may not be loaded yet."""
        return Image.open(self.path)

    def file(self) -> Source | None:
        """Return the photograph itself, or None if it has no file of its own."""
        return self


@dataclass(frozen=True)
class DatasetImage(Source):
    """An image of a torchvision dataset that is in no file of its own. `path` is its name, for messages."""

    dataset: str  # as --images names it
    index: int

    def content_hash(self) -> str:
        image = self.open()
        return "sha256:" + hashlib.sha256(f"{image.mode} {image.size} ".encode() + image.tobytes()).hexdigest()

    def open(self) -> Image.Image:
        return torchvision_datasets.read_image(self.dataset, self.index)

    def file(self) -> Source | None:
        return None


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph as (256, 256, 3) uint8 RGB, with notes on its conversion."""

    pixels: Bytes
    notes: tuple[str, ...] = ()


def list_photographs(directory: Path) -> list[Source]:
    """Return the JPEG, PNG, TIFF, BMP, PPM, WebP and AVIF files of a folder and its subfolders, sorted by path.

    A text such as `torchvision:Places365,root=DIR,split=val` in place of a folder names a dataset of torchvision.

    A linked file or folder counts as part of the folder that holds the link. One logged line names the photographs that are left
    out: files of other formats, resource forks of macOS, broken links, and folders that cannot be read.

    In MegaDepth (Li and Snavely, CVPR 2018), only files in `dense*/imgs` are photographs. In HPatches (Balntas et al., CVPR
    2017), all six files of each sequence are.

    Raises
    ------
    UserError
        if there is no such folder, or no photograph in it.
    """
    if torchvision_datasets.is_dataset(directory):
        return _list_dataset(str(directory))
    if not directory.is_dir():
        raise UserError(f"--images {directory}: no such folder")
    files, left_out = _find_files(directory)
    if left_out:
        _log_once(f"--images {directory}: left out: {_describe(left_out, directory)}")
    files = [path for path in files if path.parent.name == "imgs" and MEGADEPTH.fullmatch(path.parents[1].name)] or files
    if not files:
        raise UserError(f"--images {directory}: no photograph in it (looked for {', '.join(sorted(SUFFIXES))})")
    return [Source(path.relative_to(directory).as_posix(), path) for path in files]


def name_images(images: Path) -> str:
    """Return the name of a folder, or of a dataset of torchvision."""
    return torchvision_datasets.format_name(str(images)) if torchvision_datasets.is_dataset(images) else images.resolve().name


def _list_dataset(text: str) -> list[Source]:
    """Return the images of a dataset of torchvision. Files are sorted by path. One logged line counts those that are missing."""
    images = torchvision_datasets.list_images(text)
    files = sorted((name, path) for name, path in images if path is not None)
    if not files:
        return [DatasetImage(name, Path(name), text, index) for index, (name, _) in enumerate(images)]
    sources = [Source(name, path) for name, path in files if path.is_file()]
    if not sources:
        raise UserError(f"--images {text}: none of its {len(files)} files exists, such as {files[0][1]}")
    if missing := len(files) - len(sources):
        _log_once(f"--images {text}: left out: {missing} of {len(files)} files do not exist")
    return sources


@cache
def _log_once(line: str) -> None:
    """Log a line unless this process has: a run lists its folder several times."""
    logging.getLogger(__name__).warning(line)


def _find_files(directory: Path) -> tuple[list[Path], dict[str, list[Path]]]:
    """Find photographs. -> their paths, sorted, and by reason, those that are left out"""
    files: list[Path] = []
    left_out: dict[str, list[Path]] = {}
    pending = [(directory, frozenset[Path]())]
    while pending:
        folder, above = pending.pop()
        inside = above | {folder.resolve()}
        try:
            entries = sorted(folder.iterdir())
        except OSError as error:
            left_out.setdefault(f"cannot be read: {error.strerror}", []).append(folder)
            continue
        for entry in entries:
            if entry.is_dir():
                if entry.is_symlink() and entry.resolve() in inside:
                    left_out.setdefault("a link to a folder that contains it", []).append(entry)
                else:
                    pending.append((entry, inside))
            elif (reason := _explain_left_out(entry)) is not None:
                left_out.setdefault(reason, []).append(entry)
            elif entry.suffix.lower() in SUFFIXES:
                files.append(entry)
    return sorted(files), left_out


def _explain_left_out(path: Path) -> str | None:
    """Return why a photograph is not read; None if it is read, or is no photograph."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES | UNREAD:
        return None
    if path.name.startswith(RESOURCE_FORK):
        return "a resource fork of macOS"
    if suffix in UNREAD:
        return f"{suffix[1:].upper()} is not read; convert it to PNG or JPEG"
    return None if path.is_file() else "no file, or a broken link"


def _describe(left_out: Mapping[str, list[Path]], directory: Path) -> str:
    """Describe files that are left out in one line."""

    def list_names() -> Iterator[str]:
        for reason, paths in sorted(left_out.items()):
            names = [path.relative_to(directory).as_posix() for path in sorted(paths)[:NAMED]]
            printable = [name if name.isprintable() else ascii(name) for name in names]
            more = [f"{len(paths) - NAMED} more"] if len(paths) > NAMED else []
            yield f"{', '.join(printable + more)} ({reason})"

    return "; ".join(list_names())


def split_validation(sources: list[Source], selection: Path | None) -> tuple[list[Source], list[Source]]:
    """Return photographs split into a training set and a validation set.

    `selection` is a folder or a torchvision dataset of other photographs for validation, or a text file with the names of the
    validation photographs, one per line. For None, every twentieth photograph is for validation.

    Raises
    ------
    UserError
        if `selection` does not exist, or contains the name of no photograph.
    """
    if selection is not None and (selection.is_dir() or torchvision_datasets.is_dataset(selection)):
        return sources, list_photographs(selection)
    if selection is None:
        names = {source.name for source in sources[::20]}
    elif selection.is_file():
        try:
            names = set(selection.read_text(encoding="utf-8-sig").split("\n"))
        except UnicodeDecodeError as error:
            raise UserError(f"{selection}: not a text file: {error}") from None
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


def read(photograph: Path | Source) -> Photograph:
    """Read one photograph by the rule of this module.

    Raises
    ------
    SampleError
        if the file cannot be decoded, or is smaller than 32 pixels on a side.
    """
    image, notes = decode(photograph)
    return Photograph(crop_square(image, SIDE), notes)


def decode(photograph: Path | Source, upright: bool = True, whole: bool = False) -> tuple[Image.Image, tuple[str, ...]]:
    """Return an 8-bit RGB image, and notes on its conversion.

    It has the size of the file, except for JPEG files of more than `MAX_WHOLE` pixels. Their decoder averages 2 x 2 pixels.

    Parameters
    ----------
    upright : whether EXIF rotation is applied
    whole : whether an image of any number of pixels keeps the size of the file

    Raises
    ------
    SampleError
        if the file cannot be decoded, is smaller than 32 pixels on a side, or its values have no defined range.
    """
    source = photograph if isinstance(photograph, Source) else Source(photograph.name, photograph)
    name = source.path.name
    try:
        with source.open() as opened:
            notes = _list_remarks(opened)
            orientation = read_orientation(opened)
            if not whole and opened.width * opened.height > MAX_WHOLE:
                notes += _halve(opened)
            opened.load()
            image = _rotate(opened, orientation, upright)
        image, more = _convert(image, name)
    except Image.DecompressionBombError as error:
        raise SampleError(f"{name}: too many pixels to read safely ({error})") from error
    except (SampleError, MemoryError):
        raise
    except Exception as error:
        # Pillow's readers raise errors of any class for damaged files: OSError, SyntaxError, KeyError, struct.error, ...
        raise SampleError(f"{name}: cannot be read as an image: {error}") from error
    return image, tuple(f"{name}: {note}" for note in (*notes, *more))


def read_orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of an opened image, from 1 (upright) to 8. It is 1 if the file states no valid one.

    Only this tag is read, since the others may be damaged without harm to the picture.
    """
    try:
        with warnings.catch_warnings(action="ignore"):  # of corrupt EXIF data
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        return int(orientation) if orientation in UPRIGHT else 1
    except Exception:  # as in `decode`: damaged EXIF data raise errors of any class
        return 1


def _list_remarks(image: Image.Image) -> list[str]:
    pages = getattr(image, "n_frames", 1) if image.format == "TIFF" else 1
    return [f"{pages} pages, of which the first is read"] if pages > 1 else []


def _halve(image: Image.Image) -> list[str]:
    """Let a JPEG file that is not loaded yet be decoded at half size. -> notes; none for other formats, which cannot"""
    width, height = image.size
    drafted = image.draft(None, (width // 2, height // 2))
    return [] if drafted is None else [f"{width} x {height} pixels, decoded at half size"]


def _rotate(image: Image.Image, orientation: int, upright: bool) -> Image.Image:
    """Return the image upright or as stored. Pillow loads TIFF files upright, and all others as stored."""
    loaded_upright = image.format == "TIFF"
    if loaded_upright == upright or orientation == 1:
        return image
    return image.transpose(UPRIGHT[orientation if upright else INVERSE.get(orientation, orientation)])


def _convert(image: Image.Image, name: str) -> tuple[Image.Image, list[str]]:
    """Convert to 8-bit RGB. -> image, and notes"""
    if min(image.size) < MIN_SIDE:
        raise SampleError(f"{name}: {image.width} x {image.height} pixels; at least {MIN_SIDE} x {MIN_SIDE} are needed")
    notes = []
    if image.mode == "F":
        raise SampleError(f"{name}: its pixels are floating-point numbers of no defined range; convert it to 8 or 16 bits")
    if image.mode.startswith("I"):
        deep = np.asarray(image, dtype=np.float64)
        if deep.min() < 0 or deep.max() > DEEPEST:
            raise SampleError(f"{name}: its pixels are not between 0 and {DEEPEST}; convert it to 8 or 16 bits")
        notes.append("16 bits a channel, scaled to 8")
        image = Image.fromarray(np.rint(deep / 257.0).astype(np.uint8))
    if "A" in image.getbands() or "transparency" in image.info:
        notes.append("transparency, composited over white")
        rgba = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba)
    if image.mode in ("L", "LA", "1"):
        notes.append("grey, its channel is used as red, green and blue")
    return image.convert("RGB"), notes


def crop_square(image: Image.Image, side: int) -> Bytes:
    """Crop the largest centred square and resize it. -> (side, side, 3) uint8"""
    short = min(image.size)
    left, top = (image.width - short) // 2, (image.height - short) // 2
    box = (left, top, left + short, top + short)
    return np.array(image.crop(box).resize((side, side), Image.Resampling.BICUBIC))
