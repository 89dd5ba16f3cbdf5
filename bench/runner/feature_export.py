"""Features, releases, and what attacks recover, for other programs: hloc's HDF5 files and COLMAP's databases.

Keypoints are those of the photograph as it is stored. Of a set of words each candidate is a keypoint of its own, at the same
place: so a matcher that knows nothing of sets can match it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from bench.api import Attack, ImageAttack, Trial
from bench.cache.attack_cache import recover_cached
from bench.core.errors import SampleError, UserError
from bench.formats.stored_features import out_of_square, upright
from bench.tasks.reconstruction import view
from bench.types import Bytes, Descriptors, Floats, WordSets

SIFT = 128  # components
NORM = 512.0  # of 8-bit SIFT, as COLMAP quantises unit vectors
HALF = 0.5  # hloc's centre of the first pixel is (0, 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Described:
    """One photograph's keypoints and descriptors."""

    name: str  # its path below the folder of photographs
    path: Path
    size: tuple[int, int]  # width, height, as it is stored
    keypoints: Floats  # (N, 2) in its pixels; the centre of the first is (0.5, 0.5)
    descriptors: Floats  # (N, D) unit norm


def described(trial: Trial, path: Path, attack: Attack | None) -> Described:
    """What an attack recovers of a trial; what was released of it, if there is none.

    Raises
    ------
    UnitError
        if that is no descriptors, or the photograph has an EXIF rotation.
    """
    release = trial.release
    if isinstance(attack, ImageAttack):
        raise SampleError(f"{attack.name()} recovers no descriptors")
    if attack is not None:
        found = recover_cached(attack, trial, view(trial)).selection
        keypoints, rows = release.keypoints[found.rows], found.descriptors
    elif isinstance(release, Descriptors):
        keypoints, rows = release.keypoints, release.descriptors
    elif isinstance(release, WordSets):
        keypoints = np.repeat(release.keypoints, release.subset_size, axis=0)  # (N m, 2)
        rows = release.candidates.reshape(len(keypoints), -1)  # (N m, D)
    else:
        raise SampleError(f"a release of {type(release).__name__} has no descriptors; --attack exports what is recovered of it")
    size = upright(path)
    moved = out_of_square(keypoints.astype(np.float64), size, release.size[0]).astype(np.float32)
    return Described(name=trial.sample.name, path=path, size=size, keypoints=moved, descriptors=rows)


def to_hloc(found: Sequence[Described], out: Path) -> None:
    """A file as hloc's `extract_features` writes it: a group for each image."""
    with h5py.File(out, "w") as opened:
        for one in found:
            group = opened.create_group(one.name)
            group.create_dataset("keypoints", data=one.keypoints - np.float32(HALF))
            group.create_dataset("descriptors", data=one.descriptors.T)
            group.create_dataset("scores", data=np.ones(len(one.keypoints), np.float32))
            group.create_dataset("image_size", data=np.array(one.size))


def to_colmap(found: Sequence[Described], out: Path) -> None:
    """A database as COLMAP's feature extractor leaves it, ready to be matched. COLMAP itself reads the cameras of the images."""
    import pycolmap

    root = _root(found)
    with pycolmap.Database.open(out):
        pass  # COLMAP imports into a database that is there
    names = [one.name for one in found]
    pycolmap.import_images(out, root, camera_mode=pycolmap.CameraMode.PER_IMAGE, image_names=names)
    with pycolmap.Database.open(out) as database:
        for one in found:
            image = database.read_image_with_name(one.name)
            assert image is not None
            number = image.image_id
            database.write_keypoints(number, one.keypoints)
            kinds = pycolmap.FeatureExtractorType
            kind = kinds.SIFT if one.descriptors.shape[1] == SIFT else kinds.UNDEFINED
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, _codes(one.descriptors)))


LAYOUTS: Mapping[str, Callable[[Sequence[Described], Path], None]] = {"hloc": to_hloc, "colmap": to_colmap}


def write_pairs(out: Path, names: Sequence[str]) -> int:
    """Every pair of images, one a line, as hloc's `match_features` reads them. Returns how many."""
    pairs = list(itertools.combinations(names, 2))
    _check_names(names)
    out.write_text("".join(f"{one} {other}\n" for one, other in pairs), encoding="utf-8")
    return len(pairs)


def read_pairs(path: Path) -> list[tuple[str, str]]:
    """The pairs of a file of hloc's.

    Raises
    ------
    UserError
        naming file and line, if a line is no pair.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        fields = line.split()
        if fields and len(fields) != 2:
            raise UserError(f"{path}:{number}: a pair has two names, but there are {len(fields)}")
        if fields:
            found.append((fields[0], fields[1]))
    return found


def _check_names(names: Iterable[str]) -> None:
    for name in names:
        if len(name.split()) != 1:
            raise UserError(f"{name!r}: a list of pairs cannot hold a name with a space in it")


def _codes(rows: Floats) -> Bytes:
    return np.clip(np.rint(rows * NORM), 0, 255).astype(np.uint8)


def _root(found: Sequence[Described]) -> Path:
    """The folder that all names lie below."""
    roots = {Path(str(one.path.absolute()).removesuffix(one.name)) for one in found}
    if len(roots) != 1 or any(not (one.path.absolute().as_posix()).endswith(one.name) for one in found):
        raise UserError("COLMAP reads the images of one folder: give --images")
    return roots.pop()
