"""Export of features, releases and recovered descriptors to HDF5 files of hloc and databases of COLMAP.

Keypoints refer to the photograph as stored. Each candidate of a word set becomes a keypoint of its own at the same coordinates,
so that any matcher can match it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from bench.api import Attack, ImageAttack
from bench.cache.attack_cache import recover_cached
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import check_name, map_out_of_square, read_upright_size
from bench.images.photographs import Source
from bench.task_api import Trial
from bench.tasks.reconstruction import build_view
from bench.types import Bytes, Descriptors, Floats, WordSets

SIFT = 128  # components
NORM = 512.0  # of 8-bit SIFT, as COLMAP quantises unit vectors
ROUNDING = 0.5 / NORM  # the greatest change of a component by quantisation
HALF = 0.5  # hloc puts the centre of the first pixel at (0, 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageFeatures:
    """Keypoints and descriptors of one photograph."""

    name: str  # its path below the folder of photographs
    path: Path
    size: tuple[int, int]  # width, height, as stored
    keypoints: Floats  # (N, 2) pixels; the centre of the first pixel is (0.5, 0.5)
    descriptors: Floats  # (N, D) unit norm


def collect_features(trial: Trial, path: Path, attack: Attack | None) -> ImageFeatures:
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
    size = read_upright_size(Source(trial.sample.name, path))
    moved = map_out_of_square(keypoints.astype(np.float64), size, release.size[0]).astype(np.float32)
    return ImageFeatures(name=trial.sample.name, path=path, size=size, keypoints=moved, descriptors=rows)


def write_hloc(images: Sequence[ImageFeatures], out: Path) -> None:
    """Write a file in the format of hloc's `extract_features`: one group for each image."""
    with h5py.File(out, "w") as opened:
        for image in images:
            group = opened.create_group(image.name)
            group.create_dataset("keypoints", data=image.keypoints - np.float32(HALF))
            group.create_dataset("descriptors", data=image.descriptors.T)
            group.create_dataset("scores", data=np.ones(len(image.keypoints), np.float32))
            group.create_dataset("image_size", data=np.array(image.size))


def write_colmap(images: Sequence[ImageFeatures], out: Path) -> None:
    """Write a database in the format of COLMAP's feature extractor, with cameras that COLMAP reads from the images.

    Raises
    ------
    UserError
        if descriptors have negative components, or COLMAP cannot read one of the images; no file is left.
    """
    import pycolmap

    root = _find_root(images)
    for image in images:
        if image.descriptors.min(initial=0.0) < -ROUNDING:
            raise UserError(
                f"{image.name}: descriptors have negative components, and those of --layout colmap are 8-bit without a sign, "
                "as SIFT; give --layout hloc"
            )
    with pycolmap.Database.open(out):
        pass  # import_images needs an existing database
    names = [image.name for image in images]
    pycolmap.import_images(out, root, camera_mode=pycolmap.CameraMode.PER_IMAGE, image_names=names)
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
        raise UserError(f"{unread[0]}: COLMAP cannot read this image; convert it to PNG or JPEG, or give --layout hloc")


LAYOUTS: Mapping[str, Callable[[Sequence[ImageFeatures], Path], None]] = {"hloc": write_hloc, "colmap": write_colmap}


def _quantise(rows: Floats) -> Bytes:
    return np.clip(np.rint(rows * NORM), 0, 255).astype(np.uint8)


def _find_root(images: Sequence[ImageFeatures]) -> Path:
    """Return the folder that contains all images."""
    roots = {Path(str(image.path.absolute()).removesuffix(image.name)) for image in images}
    if len(roots) != 1 or any(not (image.path.absolute().as_posix()).endswith(image.name) for image in images):
        raise UserError("COLMAP needs all images in one folder; give --images")
    return roots.pop()
