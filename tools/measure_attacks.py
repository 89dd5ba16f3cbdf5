"""Measures every attack at the same settings, and where the stronger ones fail, and writes docs/attacks.md.

    python tools/measure_attacks.py --data ../shared/data --work work/attacks

1. All attacks on the same releases of the whole built-in photographs: recovered descriptors and images, and the difference from
   the strongest attack of the paper.
2. Descriptors found exactly, for a database of centres (the shipped one) and for one of raw descriptors, and by the number of
   zeros of the descriptor.
3. Milliseconds of one core per descriptor.

Records in WORK are reused.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import bench
from attacks.lattice import Lattice
from attacks.sparsity import Sparsity
from bench.api import Attack, Defense, DescriptorAttack, ImageAttack, View
from bench.codebook import dictionary
from bench.codebook.public import Public
from bench.core.progress import Progress
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.geometry.lattice import find_unit_integer_points
from bench.images import photographs
from bench.registry import discovery, spec
from bench.runner.other_releases import ReleasePool
from bench.runner.records import Record
from bench.settings import Asset
from bench.threat_model import DefenseDatabase, OtherReleases, PublicAssets, PublicDatabase
from bench.types import Features, Subspaces
from defenses.affine import Affine
from leaderboard.intervals import Interval, interval

TABLE = Path(__file__).parents[1] / "docs" / "attacks.md"
TITLE = """# What the attacks recover

Written by `tools/measure_attacks.py`: the seven built-in photographs, all keypoints, upright SIFT, seed 0, attacks as they are
configured by default (`docs/tuning.md`). In brackets: 95% bootstrap over photographs.
"""
DIMS = (2, 4, 8, 16)
SUBSPACES = tuple(f"affine:dim={dim}" for dim in DIMS)
WORD_SETS = tuple(f"ldp:epsilon={epsilon},subset_size=2" for epsilon in (16, 12, 10))
# The first is the reference.
ON_SUBSPACES = ("database", "clustering", "dia", "nearest", "lattice", "repeat", "sparsity", "intersection", "keypoints")
ON_WORD_SETS = ("dia", "context", "repeat", "repeat:releases=4", "keypoints")
TIMED_ON = 2  # photographs
TIMED = ("database", "clustering", "nearest", "lattice", "sparsity", "intersection", "dia")
SHOWN = {"recovered": 3, "angle": 1, "ssim": 3, "psnr": 2}  # metric -> digits
EXACT = 1e-5  # distance below which an estimate counts as the descriptor
RAW_ROWS = 16_000  # of the database of raw descriptors: as many as a sub-database has
COLUMNS = ("sparsity", "lattice", "sparsity, raw rows", "lattice, raw rows", "candidates, raw rows")
ZEROS = {"none": (-128, 0), "1 to 4": (1, 4), "5 to 12": (5, 12), "more": (13, 128)}  # of a descriptor, beyond the dimension


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument("--work", type=Path, required=True, help="folder of records, reused between runs")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    parts = [
        TITLE,
        write_comparison("Subspaces", SUBSPACES, ON_SUBSPACES, "recovered", args.work),
        write_comparison("Word sets", WORD_SETS, ON_WORD_SETS, "ssim", args.work),
        write_exact(build_raw_database(args.data, args.work)),
        write_speed(),
    ]
    TABLE.write_text("\n".join(parts), encoding="utf-8")


# ---- all attacks at the same settings


def write_comparison(title: str, defenses: Sequence[str], attacks: Sequence[str], by: str, work: Path) -> str:
    """Write a table of every attack against every defense, with paired differences from the first attack in the metric `by`."""
    lines = [
        f"## {title}",
        "",
        "`recovered`: share of descriptors for which, of all in the photograph, the true one is nearest to the estimate. "
        f"`angle`: in degrees. Then the difference in {by} from `{attacks[0]}` on the same photographs, and what the attack "
        "says of its run on the first of them.",
        "",
        markdown_row(("defense", "attack", "recovered", "angle", "SSIM", "PSNR", f"{by} less {attacks[0]}'s", "it says")),
        markdown_row(["---"] * 8),
    ]
    strongest = []
    for written in defenses:
        results = {attack: run(written, attack, work) for attack in attacks}
        first = list_values(results[attacks[0]], by)
        for attack, records in results.items():
            values = list_values(records, by)
            apart = "" if attack == attacks[0] or not len(values) else format_interval(interval(values - first), 3)
            columns = [format_values(records, metric, digits) for metric, digits in SHOWN.items()]
            lines.append(markdown_row((f"`{written}`", f"`{attack}`", *columns, apart, join_notes(records))))
        means = {attack: values.mean() for attack, records in results.items() if len(values := list_values(records, by))}
        strongest.append(f"`{max(means, key=lambda attack: means[attack])}` at `{written}`")
    return "\n".join([*lines, "", f"Strongest by {by}: {', '.join(strongest)}.", ""])


def run(defense: str, attack: str, work: Path) -> list[Record]:
    print(defense, attack, flush=True)
    return bench.run([spec.read(defense, discovery.DEFENSE)], [spec.read(attack, discovery.ATTACK)], out=work)


def list_values(records: Sequence[Record], metric: str) -> np.ndarray:
    """List the values of a metric. -> (photographs,), empty if it does not apply"""
    return np.array([value for record in records if (value := record["metrics"].get(metric)) is not None])


def format_values(records: Sequence[Record], metric: str, digits: int) -> str:
    values = list_values(records, metric)
    return format_interval(interval(values), digits) if len(values) else "n/a"


def format_interval(value: Interval, digits: int) -> str:
    return f"{value.mean:.{digits}f} [{value.low:.{digits}f}, {value.high:.{digits}f}]"


def join_notes(records: Sequence[Record]) -> str:
    """Join the notes of an attack on the first photograph."""
    return "; ".join(records[0]["notes"])


# ---- exact recovery


def build_raw_database(data: Path, work: Path) -> Asset:
    """Build a database whose words are raw descriptors of `tune.txt`."""
    path = work / "raw-rows.safetensors"
    if not path.is_file():
        names = (data / "tune.txt").read_text().split()
        results = [Sift().extract(photographs.read(data / "train" / name).pixels).codes for name in names]
        rows = np.unique(np.concatenate([codes for codes in results if codes is not None]), axis=0)
        subset = np.random.default_rng(0).permutation(len(rows))[:RAW_ROWS]
        dictionary.save(path, rows[subset], {"photographs": []})
    return Asset(path)


def write_exact(raw: Asset) -> str:
    """Write the fractions that `sparsity` and `lattice` find exactly, on whole photographs."""
    shares = [markdown_row(("dim", *COLUMNS)), markdown_row(["---"] * (1 + len(COLUMNS)))]
    zeros = [markdown_row(("dim", *ZEROS)), markdown_row(["---"] * (1 + len(ZEROS)))]
    for dim in DIMS:
        results = [list(find_exact(dim, secret, raw)) for secret in extract_all()]  # (photographs, columns) of (N,) bool
        means = np.array([[hit.mean() for hit in hits] for hits in results])
        shares.append(markdown_row((dim, *(format_interval(interval(column), 3) for column in means.T))))
        hit = np.concatenate([hits[0] for hits in results])
        beyond = np.concatenate([(secret.descriptors == 0).sum(axis=1) for secret in extract_all()]) - dim
        parts = [(beyond >= low) & (beyond <= high) for low, high in ZEROS.values()]
        zeros.append(markdown_row((dim, *(format_fraction(hit, part) for part in parts))))
        print(shares[-1], zeros[-1], sep="\n", flush=True)
    return "\n".join(
        [
            "## Found exactly",
            "",
            f"Share of descriptors that are found to {EXACT:g} by `sparsity` and `lattice`, which know nothing. *Raw rows*: the",
            f"database is not the shipped one, whose words are centres of clusters, but {RAW_ROWS:,} descriptors as they are.",
            "*Candidates*: `lattice` has the descriptor among the points that it finds, whether or not it takes it.",
            "",
            *shares,
            "",
            "`sparsity`, shipped database, by how many more zeros the descriptor has than the subspace dimensions: found so",
            "often, of so many. Without any it is no degenerate vertex, and cannot be found.",
            "",
            *zeros,
            "",
        ]
    )


def find_exact(dim: int, secret: Features, raw: Asset) -> Iterator[np.ndarray]:
    """Yield which descriptors are found, in the order of COLUMNS. -> (N,) bool each"""
    for database, parts in ((Asset("shipped"), 16), (raw, 1)):
        view = create_view(Affine(dim=dim, database=database, sub_databases=parts), secret)
        for attack in (Sparsity(), Lattice()):
            estimates = attack.recover(view, np.random.default_rng(0))
            yield np.linalg.norm(estimates - secret.descriptors, axis=1) < EXACT
    assert isinstance(view.release, Subspaces)
    owners, points = find_unit_integer_points(view.release, Lattice.longest)
    hit = np.linalg.norm(points - secret.descriptors[owners], axis=1) < EXACT
    yield np.isin(np.arange(len(secret)), owners[hit])


def format_fraction(hits: np.ndarray, subset: np.ndarray) -> str:
    """Format the fraction of hits in a subset of the descriptors, and the size of the subset."""
    return f"{hits[subset].mean():.3f} of {subset.mean():.0%}" if subset.any() else "none"


def extract_all() -> Iterator[Features]:
    for source in photographs.list_builtin():
        yield Sift().extract(photographs.read(source.path).pixels, source.path)


# ---- speed


def write_speed() -> str:
    """Write the processor time of `recover` alone, on whole photographs; other releases are drawn beforehand."""
    lines = [
        "## Milliseconds a descriptor",
        "",
        f"Processor time of the attack alone, by the photograph's keypoints; mean over the first {TIMED_ON} photographs. Not",
        "counted: what is computed once, such as other users' releases; and image reconstruction, except for `dia`.",
        "",
        markdown_row(("attack", *(f"dim {dim}" for dim in DIMS))),
        markdown_row(["---"] * (1 + len(DIMS))),
    ]
    features = list(zip(photographs.list_builtin(), extract_all(), strict=True))[:TIMED_ON]
    spent: dict[str, list[list[float]]] = {name: [[] for _ in DIMS] for name in TIMED}
    with Progress("speed", len(TIMED) * len(DIMS) * len(features)) as progress:
        for column, dim in enumerate(DIMS):
            defense = Affine(dim=dim)
            pool = release_others(defense)
            for source, secret in features:
                view = create_view(defense, secret, pool, source.name)
                for name in TIMED:
                    spent[name][column].append(1e3 * measure_seconds(spec.read(name, discovery.ATTACK), view) / len(secret))
                    progress.advance(note=f"{name}, dim {dim}")
    lines += [markdown_row((f"`{name}`", *(f"{np.mean(values):.2f}" for values in spent[name]))) for name in TIMED]
    return "\n".join([*lines, ""])


def measure_seconds(attack: Attack, view: View) -> float:
    """Return the processor time for one photograph in seconds."""
    view = replace(view, notes=[])
    rng = np.random.default_rng(0)
    started = time.process_time()
    if isinstance(attack, DescriptorAttack):
        attack.recover(view, rng)
    elif isinstance(attack, ImageAttack):
        attack.reconstruct(view, rng)
    return time.process_time() - started


# ---- views


def create_view(defense: Defense, secret: Features, pool: ReleasePool | None = None, photograph: str = "") -> View:
    """Create a view with all kinds of knowledge."""
    public = PUBLIC
    knowledge = {
        DefenseDatabase: lambda: DefenseDatabase(words=public.dictionary(Asset("shipped")).words),
        PublicDatabase: lambda: PublicDatabase(words=public.dictionary(Asset("shipped-public")).words),
        PublicAssets: lambda: PublicAssets(assets=public),
        OtherReleases: lambda: OtherReleases(draw=pool.without(photograph) if pool else lambda count: iter(())),
    }
    release = defense.protect(secret, public, np.random.default_rng(0))
    return View(release=release, defense=defense, extractor=Sift(), knowledge=knowledge)


def release_others(defense: Affine) -> ReleasePool:
    """Draw the maximum number of other releases that an attack reads."""
    pool = ReleasePool(photographs.list_builtin(), Sift(), defense, PUBLIC, functools.partial(create_generator, defense.dim))
    for source in photographs.list_builtin():
        for _ in pool.without(source.name)(800):
            pass
    return pool


def create_generator(dim: int, *parts: object) -> np.random.Generator:
    return np.random.default_rng([dim, *str(parts).encode()])


PUBLIC = Public()


if __name__ == "__main__":
    main()
