"""Published datasets, and their download into a folder: `bench dataset fetch`.

Addresses, checksums and licences are those of the sources that each entry names. None of them could be tried where this was
written, without a network.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from bench.core.errors import UserError, unknown_name
from bench.formats import archives
from bench.formats.download import CHECKSUM, download

RECORD = "fetched.json"  # in the folder of a dataset: what was downloaded, and whether its checksum was verified


@dataclass(frozen=True, kw_only=True)
class File:
    """A file of a dataset. Archives are unpacked, and then removed."""

    url: str
    gigabytes: float | None  # about; None: unknown
    checksum: str | None = None  # None: none is published
    folder: str = ""  # below that of the dataset

    @property
    def name(self) -> str:
        return self.url.rpartition("/")[2]


@dataclass(frozen=True, kw_only=True)
class Published:
    """A published dataset."""

    title: str
    licence: str
    page: str  # of the publisher
    files: tuple[File, ...]
    usage: str  # options that read it from DIR


UNKNOWN = "not known to us; read the terms on the page, and cite the article"
AACHEN = "https://data.ciirc.cvut.cz/public/projects/2020VisualLocalization/Aachen-Day-Night/"
HPATCHES = "https://huggingface.co/datasets/vbalnt/hpatches/resolve/main/hpatches-sequences-release.zip"
EPFL = "https://documents.epfl.ch/groups/c/cv/cvlab-unit/www/data/multiview/"
PLACES365 = "http://data.csail.mit.edu/places/places365/"
PLACES365_LICENCE = "non-commercial research and education, by the terms of the page"
PLACES365_PAGE = "http://places2.csail.mit.edu/download.html"
PLACES365_LISTS = File(
    url=PLACES365 + "filelist_places365-standard.tar", gigabytes=None, checksum="md5:35a0585fee1fa656440f3ab298f8479c"
)

DATASETS: Mapping[str, Published] = {
    "aachen-v1.1": Published(
        title="Aachen Day-Night v1.1 (Zhang et al., IJCV 2020)",
        licence="CC BY-NC-SA 4.0, for non-commercial academic use",
        page=AACHEN + "README_Aachen-Day-Night.md",
        files=(  # hloc's README names the archives; those of version 1.1 add to those of version 1
            File(url=AACHEN + "images/database_and_query_images.zip", gigabytes=None),
            File(url=AACHEN + "queries/day_time_queries_with_intrinsics.txt", gigabytes=0.0, folder="queries"),
            File(url=AACHEN + "queries/night_time_queries_with_intrinsics.txt", gigabytes=0.0, folder="queries"),
            File(url=AACHEN + "aachen_v1_1.zip", gigabytes=None),
        ),
        usage="--dataset aachen:path=DIR,version=v1.1",
    ),
    "fountain-p11": Published(
        title="Fountain-P11 (Strecha et al., CVPR 2008)",
        licence=UNKNOWN,
        page=EPFL + "denseMVS.html",
        files=(File(url=EPFL + "data/fountain_dense/urd/fountain_dense_images.tar.gz", gigabytes=None),),
        usage="--dataset captured:path=DIR,leading=9",
    ),
    "hpatches": Published(
        title="HPatches, full image sequences (Balntas et al., CVPR 2017)",
        licence="MIT for the dataset; its references.txt lists the authors of sequences from elsewhere",
        page="https://github.com/hpatches/hpatches-dataset",
        files=(File(url=HPATCHES, gigabytes=1.3),),
        usage="--images DIR",
    ),
    "megadepth": Published(
        title="MegaDepth v1 (Li and Snavely, CVPR 2018)",
        licence=UNKNOWN,
        page="https://www.cs.cornell.edu/projects/megadepth/",
        files=(
            File(url="https://www.cs.cornell.edu/projects/megadepth/dataset/Megadepth_v1/MegaDepth_v1.tar.gz", gigabytes=213.5),
        ),
        usage="--images DIR",
    ),
    "places365-train-256": Published(
        title="Places365-Standard, training images of 256 x 256 pixels (Zhou et al., TPAMI 2017)",
        licence=PLACES365_LICENCE,
        page=PLACES365_PAGE,
        files=(  # checksums of torchvision
            File(
                url=PLACES365 + "train_256_places365standard.tar", gigabytes=24, checksum="md5:53ca1c756c3d1e7809517cc47c5561c5"
            ),
        ),
        usage="--images DIR",
    ),
    "places365-val": Published(
        title="Places365, validation images (Zhou et al., TPAMI 2017)",
        licence=PLACES365_LICENCE,
        page=PLACES365_PAGE,
        files=(
            PLACES365_LISTS,
            File(url=PLACES365 + "val_large.tar", gigabytes=2.1, checksum="md5:9b71c4993ad89d2d8bcbdc4aef38042f"),
        ),
        usage="--images torchvision:Places365,root=DIR,split=val",
    ),
    "places365-val-256": Published(
        title="Places365, validation images of 256 x 256 pixels (Zhou et al., TPAMI 2017)",
        licence=PLACES365_LICENCE,
        page=PLACES365_PAGE,
        files=(
            PLACES365_LISTS,
            File(url=PLACES365 + "val_256.tar", gigabytes=0.5, checksum="md5:e27b17d8d44f4af9a78502beb927f808"),
        ),
        usage="--images torchvision:Places365,root=DIR,split=val,small=true",
    ),
    "south-building": Published(
        title="South Building (Häne et al., CVPR 2013), of COLMAP's datasets",
        licence=UNKNOWN,
        page="https://colmap.github.io/datasets.html",
        files=(File(url="https://github.com/colmap/colmap/releases/download/3.11.1/south-building.zip", gigabytes=None),),
        usage="--dataset captured:path=DIR/south-building/images,leading=96",
    ),
}


def find(name: str) -> Published:
    """Return the dataset of that name.

    Raises
    ------
    UserError
        if there is none.
    """
    if name not in DATASETS:
        raise unknown_name("published dataset", name, DATASETS)
    return DATASETS[name]


def describe(name: str, folder: Path | None = None) -> str:
    """Return licence, files, and use in a folder, of a dataset, as lines of text."""
    dataset = find(name)
    lines = [dataset.title, f"licence: {dataset.licence}", f"terms: {dataset.page}"]
    for file in dataset.files:
        size = "size unknown" if file.gigabytes is None else f"about {file.gigabytes:g} GB" if file.gigabytes else "small"
        lines.append(f"file: {file.url} ({size}; {file.checksum or 'no published checksum'})")
    usage = dataset.usage if folder is None else dataset.usage.replace("DIR", str(folder))
    return "\n".join([*lines, f"use: {usage}"])


def fetch(name: str, folder: Path, checksums: Mapping[str, str], unverified: bool = False) -> Iterator[str]:
    """Download the files of a dataset that `folder` lacks, unpack them, and yield a line about each.

    Parameters
    ----------
    checksums : by name of the file; they override the published ones
    unverified : whether files without a checksum are accepted

    Raises
    ------
    OSError
        if the server or the disk fails. The next call resumes.
    UserError
        if a checksum is missing or wrong, an archive is damaged, or the folder holds something else.
    """
    dataset = find(name)
    for file, checksum in checksums.items():
        if file not in (names := [each.name for each in dataset.files]):
            raise unknown_name(f"file of {name}", file, names)
        if not CHECKSUM.fullmatch(checksum):
            raise UserError(f"--checksum {file}={checksum}: expected md5: and 32, or sha256: and 64 hexadecimal digits")
    lacking = [file.name for file in dataset.files if (checksums.get(file.name) or file.checksum) is None]
    if lacking and not unverified:
        raise UserError(
            f"{name}: no checksum is published for {', '.join(lacking)}; give --checksum FILE=sha256:..., or accept unverified "
            "files with --unverified"
        )
    _read_record(name, folder)  # creates a new folder
    with _lock(folder):
        yield from _fetch_files(name, folder, checksums)


def _fetch_files(name: str, folder: Path, checksums: Mapping[str, str]) -> Iterator[str]:
    fetched = _read_record(name, folder)
    for file in find(name).files:
        checksum = checksums.get(file.name) or file.checksum
        if file.url in fetched:
            earlier = fetched[file.url]
            if (checksum or "").startswith("sha256:") and checksum != earlier["digest"]:
                raise UserError(f"--to {folder}: holds {file.name} of {earlier['digest']}, not {checksum}; give a new folder")
            yield f"{file.name}: fetched before, {_format_state(earlier['verified'])}"
            continue
        path = folder / file.folder / file.name
        path.parent.mkdir(exist_ok=True)
        digest = download(file.url, path, checksum)
        count = archives.unpack(path, folder) if archives.is_archive(file.name) else 1
        fetched[file.url] = {"digest": digest, "verified": checksum}
        _write_record(name, folder, fetched)
        if archives.is_archive(file.name):
            path.unlink()
        yield f"{file.name}: {count} files, {_format_state(checksum)}, {digest}"


def _format_state(checksum: str | None) -> str:
    return "NOT VERIFIED" if checksum is None else f"verified by {checksum.partition(':')[0]}"


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Let one process at a time write a folder."""
    try:
        with FileLock(folder / f".{RECORD}.lock", timeout=0):
            yield
    except Timeout:
        raise UserError(f"--to {folder}: another process writes it; wait for its end") from None


def _read_record(name: str, folder: Path) -> dict[str, dict[str, str | None]]:
    """Return what was fetched into a folder before, by address. A new folder is created."""
    record = folder / RECORD
    if not record.is_file():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UserError(f"--to {folder}: holds something else; give a new folder")
        folder.mkdir(parents=True, exist_ok=True)
        _write_record(name, folder, {})
    try:
        content = json.loads(record.read_text(encoding="utf-8"))
        earlier, files = content["dataset"], dict(content["files"])
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{record}: damaged; give a new folder") from None
    if earlier != name:
        raise UserError(f"--to {folder}: holds {earlier}; give a new folder")
    return files


def _write_record(name: str, folder: Path, files: Mapping[str, Mapping[str, str | None]]) -> None:
    temporary = folder / f"{RECORD}.part"
    temporary.write_text(json.dumps({"dataset": name, "files": files}, indent=1), encoding="utf-8")
    temporary.replace(folder / RECORD)
