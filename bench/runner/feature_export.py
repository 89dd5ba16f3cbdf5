"""Export of features, releases and recovered descriptors to HDF5 files of hloc and databases of COLMAP.

Keypoints refer to the photograph as stored, also where only its central square was read. Each candidate of a word set becomes a
keypoint of its own at the same coordinates, so that any matcher can match it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import h5py
import numpy as np

from bench.api import Attack, ImageAttack
from bench.cache.attack_cache import recover_cached
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import check_name, map_out_of_square, read_upright_size
from bench.images.photographs import Source
from bench.images.samples import Sample
from bench.images.scene import File
from bench.localization.scene_index import SceneIndex
from bench.task_api import Trial
from bench.tasks.reconstruction import build_view
from bench.types import Bytes, Descriptors, Floats, WordSets

SIFT = 128  # components
NORM = 512.0  # of 8-bit SIFT, as COLMAP quantises unit vectors
ROUNDING = 0.5 / NORM  # the greatest change of a component by quantisation
HALF = 0.5  # hloc puts the centre of the first pixel at (0, 0)

Layout = Literal["hloc", "colmap"]
CameraMode = Literal["auto", "single", "per_folder", "per_image"]  # COLMAP's: which images of a database share a camera


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageFeatures:
    """Keypoints and descriptors of one photograph."""

    name: str  # its path below the folder of photographs
    path: Path | None  # None if it is rendered
    size: tuple[int, int]  # width, height, as stored
    keypoints: Floats  # (N, 2) pixels; the centre of the first pixel is (0.5, 0.5)
    descriptors: Floats  # (N, D) unit norm


def open_whole(sample: Sample) -> Sample:
    """Return a photograph as a sample of the stored image, in place of its central square of 256 x 256 pixels.

    Raises
    ------
    SampleError
        if the photograph has an EXIF rotation, which other programs ignore, or cannot be read.
    """
    (source,) = sample.images
    if not isinstance(source, Source):
        return sample
    if source.file() is None:
        raise SampleError(f"{source.name}: it is in no file of its own; export without --full-images")
    return replace(sample, images=(File(path=source.path, size=read_upright_size(source), name=source.name),))


def collect_features(trial: Trial, attack: Attack | None) -> ImageFeatures:
    """Return the descriptors that an attack recovers, or the released ones if `attack` is None.

    Raises
    ------
    SampleError
        if there are no descriptors, the photograph has an EXIF rotation, or its name is not UTF-8, as other programs need it.
    """
    check_name(trial.sample.name)
    release = trial.release
    if isinstance(attack, ImageAttack):
        raise SampleError(f"{attack.name()} does not recover descriptors")
    if attack is not None:
        selection = recover_cached(attack, trial, build_view(trial)).selection
        keypoints, rows = release.keypoints[selection.rows], selection.descriptors
    elif isinstance(release, Descriptors):
        keypoints, rows = release.keypoints, release.descriptors
    elif isinstance(release, WordSets):
        keypoints = np.repeat(release.keypoints, release.subset_size, axis=0)  # (N m, 2)
        rows = release.candidates.reshape(len(keypoints), -1)  # (N m, D)
    else:
        raise SampleError(f"a release of {type(release).__name__} has no descriptors; give --attack to export recovered ones")
    (image,) = trial.sample.images
    size = release.size
    if isinstance(image, Source):
        size = read_upright_size(image)
        keypoints = map_out_of_square(keypoints.astype(np.float64), size, release.size[0]).astype(np.float32)
    file = image.file()
    path = None if file is None else file.path
    return ImageFeatures(name=trial.sample.name, path=path, size=size, keypoints=keypoints, descriptors=rows)


def collect_references(index: SceneIndex) -> Iterator[ImageFeatures]:
    """Yield the raw features of a scene's references, which the server holds without a defense.

    Raises
    ------
    SampleError
        if a reference cannot be read.
    """
    for image, features in zip(index.scene.references, index.reference_features, strict=True):
        file = image.pixels.file()
        yield ImageFeatures(
            name=image.name,
            path=None if file is None else file.path,
            size=features.size,
            keypoints=features.keypoints,
            descriptors=features.descriptors,
        )


def write_hloc(images: Sequence[ImageFeatures], out: Path) -> None:
    """Write a file in the format of hloc's `extract_features`: one group for each image."""
    with h5py.File(out, "w") as opened:
        for image in images:
            group = opened.create_group(image.name)
            group.create_dataset("keypoints", data=image.keypoints - np.float32(HALF))
            group.create_dataset("descriptors", data=image.descriptors.T)
            group.create_dataset("scores", data=np.ones(len(image.keypoints), np.float32))
            group.create_dataset("image_size", data=np.array(image.size))


def write_colmap(images: Sequence[ImageFeatures], out: Path, camera_mode: CameraMode) -> None:
    """Write a database in the format of COLMAP's feature extractor, with cameras that COLMAP reads from the images.

    Raises
    ------
    UserError
        if descriptors have negative components, or COLMAP cannot read one of the images; no file is left.
    """
    import pycolmap

    root, mode = _find_root(images), pycolmap.CameraMode.__members__[camera_mode.upper()]
    for image in images:
        if image.descriptors.min(initial=0.0) < -ROUNDING:
            raise UserError(
                f"{image.name}: descriptors have negative components, and those of --layout colmap are 8-bit without a sign, "
                "as SIFT; give --layout hloc"
            )
    with pycolmap.Database.open(out):
        pass  # import_images needs an existing database
    names = [image.name for image in images]
    pycolmap.import_images(out, root, camera_mode=mode, image_names=names)
    with pycolmap.Database.open(out) as database:
        numbers = {row.name: row.image_id for row in database.read_all_images()}
        unread = [name for name in names if name not in numbers]
        for image in images if not unread else ():
            database.write_keypoints(numbers[image.name], image.keypoints)
            kinds = pycolmap.FeatureExtractorType
            kind = kinds.SIFT if image.descriptors.shape[1] == SIFT else kinds.UNDEFINED
            database.write_descriptors(numbers[image.name], pycolmap.FeatureDescriptors(kind, _quantise(image.descriptors)))
    if unread:
        out.unlink()
        shared = camera_mode in ("single", "per_folder")
        raise UserError(
            f"{unread[0]}: COLMAP cannot read this image{', or its size is not that of its camera' if shared else ''}; "
            f"{'give --camera-mode per_image, ' if shared else ''}convert it to PNG or JPEG, or give --layout hloc"
        )


def _quantise(rows: Floats) -> Bytes:
    return np.clip(np.rint(rows * NORM), 0, 255).astype(np.uint8)


def _find_root(images: Sequence[ImageFeatures]) -> Path:
    """Return the folder that contains all images."""
    paths = [image.path.absolute() for image in images if image.path is not None]
    if len(paths) < len(images):
        raise UserError("COLMAP needs images in files of their own; write a rendered dataset by `bench dataset` first")
    roots = {Path(str(path).removesuffix(image.name)) for path, image in zip(paths, images, strict=True)}
    if len(roots) != 1 or any(not path.as_posix().endswith(image.name) for path, image in zip(paths, images, strict=True)):
        raise UserError("COLMAP needs all images in one folder; give --images")
    return roots.pop()
