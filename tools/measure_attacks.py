"""Measures every attack at the same points, and where the stronger ones fail, and writes docs/attacks.md.

    python tools/measure_attacks.py --data ../shared/data --work work/attacks

1. All attacks on the same releases of the built-in photographs, whole: what is recovered of descriptors and of the picture, and
   how that differs from the strongest attack of the paper.
2. What finds a descriptor exactly, for a database of centres (the shipped one) and for one of raw descriptors, and by the number
   of the descriptor's zeros.
3. Milliseconds of one core for each descriptor.

Records are kept in WORK; what they hold is not done again.
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
from bench.core.table import markdown_row

TABLE = Path(__file__).parents[1] / "docs" / "attacks.md"
TITLE = """# What the attacks recover

Written by `tools/measure_attacks.py`: the seven built-in photographs, all keypoints, upright SIFT, seed 0, attacks as they are
configured by default (`docs/tuning.md`). In brackets: 95% bootstrap over photographs.
"""
DIMS = (2, 4, 8, 16)
SUBSPACES = tuple(f"affine:dim={dim}" for dim in DIMS)
WORD_SETS = tuple(f"ldp:epsilon={epsilon},subset_size=2" for epsilon in (16, 12, 10))
# The first is what the others are compared with.
ON_SUBSPACES = ("database", "clustering", "dia", "nearest", "lattice", "repeat", "sparsity", "intersection", "keypoints")
ON_WORD_SETS = ("dia", "context", "repeat", "repeat:releases=4", "keypoints")
TIMED_ON = 2  # photographs
TIMED = ("database", "clustering", "nearest", "lattice", "sparsity", "intersection", "dia")
SHOWN = {"recovered": 3, "angle": 1, "ssim": 3, "psnr": 2}  # metric -> digits
EXACT = 1e-5  # an estimate that is nearer to the descriptor than this is the descriptor
RAW_ROWS = 16_000  # of the database of raw descriptors: as many as a sub-database has
COLUMNS = ("sparsity", "lattice", "sparsity, raw rows", "lattice, raw rows", "candidates, raw rows")
ZEROS = {"none": (-128, 0), "1 to 4": (1, 4), "5 to 12": (5, 12), "more": (13, 128)}  # of a descriptor, beyond the dimension


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder of tune.txt and train/")
    parser.add_argument("--work", type=Path, required=True, help="records are kept here")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    parts = [
        TITLE,
        compared("Subspaces", SUBSPACES, ON_SUBSPACES, "recovered", args.work),
        compared("Word sets", WORD_SETS, ON_WORD_SETS, "ssim", args.work),
        exact(raw_database(args.data, args.work)),
        speed(),
    ]
    TABLE.write_text("\n".join(parts), encoding="utf-8")


# ---- all attacks at the same points


def compared(title: str, defenses: Sequence[str], attacks: Sequence[str], by: str, work: Path) -> str:
    """A table of every attack against every defense, with paired differences from the first attack in the metric `by`."""
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
        found = {attack: run(written, attack, work) for attack in attacks}
        first = measured(found[attacks[0]], by)
        for attack, records in found.items():
            values = measured(records, by)
            apart = "" if attack == attacks[0] or not len(values) else shown(interval(values - first), 3)
            columns = [cell(records, metric, digits) for metric, digits in SHOWN.items()]
            lines.append(markdown_row((f"`{written}`", f"`{attack}`", *columns, apart, said(records))))
        means = {attack: values.mean() for attack, records in found.items() if len(values := measured(records, by))}
        strongest.append(f"`{max(means, key=lambda attack: means[attack])}` at `{written}`")
    return "\n".join([*lines, "", f"Strongest by {by}: {', '.join(strongest)}.", ""])


def run(defense: str, attack: str, work: Path) -> list[Record]:
    print(defense, attack, flush=True)
    return bench.run([spec.read(defense, discovery.DEFENSE)], [spec.read(attack, discovery.ATTACK)], out=work)


def measured(records: Sequence[Record], metric: str) -> np.ndarray:
    """(photographs,), none where the metric does not apply"""
    return np.array([value for record in records if (value := record["metrics"].get(metric)) is not None])


def cell(records: Sequence[Record], metric: str, digits: int) -> str:
    values = measured(records, metric)
    return shown(interval(values), digits) if len(values) else "n/a"


def shown(value: Interval, digits: int) -> str:
    return f"{value.mean:.{digits}f} [{value.low:.{digits}f}, {value.high:.{digits}f}]"


def said(records: Sequence[Record]) -> str:
    """What an attack says of its run on the first photograph."""
    return "; ".join(records[0]["notes"])


# ---- exact recovery


def raw_database(data: Path, work: Path) -> Asset:
    """A database whose words are descriptors of `tune.txt`, as they are."""
    path = work / "raw-rows.safetensors"
    if not path.is_file():
        names = (data / "tune.txt").read_text().split()
        found = [Sift().extract(photographs.read(data / "train" / name).pixels).codes for name in names]
        rows = np.unique(np.concatenate([codes for codes in found if codes is not None]), axis=0)
        chosen = np.random.default_rng(0).permutation(len(rows))[:RAW_ROWS]
        dictionary.save(path, rows[chosen], {"photographs": []})
    return Asset(path)


def exact(raw: Asset) -> str:
    """What `sparsity` and `lattice` find exactly, on whole photographs."""
    shares = [markdown_row(("dim", *COLUMNS)), markdown_row(["---"] * (1 + len(COLUMNS)))]
    zeros = [markdown_row(("dim", *ZEROS)), markdown_row(["---"] * (1 + len(ZEROS)))]
    for dim in DIMS:
        found = [list(trial(dim, secret, raw)) for secret in secrets()]  # (photographs, columns) of (N,) bool
        means = np.array([[hit.mean() for hit in hits] for hits in found])
        shares.append(markdown_row((dim, *(shown(interval(column), 3) for column in means.T))))
        hit = np.concatenate([hits[0] for hits in found])
        beyond = np.concatenate([(secret.descriptors == 0).sum(axis=1) for secret in secrets()]) - dim
        parts = [(beyond >= low) & (beyond <= high) for low, high in ZEROS.values()]
        zeros.append(markdown_row((dim, *(within(hit, part) for part in parts))))
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


def trial(dim: int, secret: Features, raw: Asset) -> Iterator[np.ndarray]:
    """Which descriptors are found, in the order of COLUMNS. -> (N,) bool each"""
    for database, parts in ((Asset("shipped"), 16), (raw, 1)):
        seen = view(Affine(dim=dim, database=database, sub_databases=parts), secret)
        for attack in (Sparsity(), Lattice()):
            estimates = attack.recover(seen, np.random.default_rng(0))
            yield np.linalg.norm(estimates - secret.descriptors, axis=1) < EXACT
    assert isinstance(seen.release, Subspaces)
    owners, points = find_unit_integer_points(seen.release, Lattice.longest)
    hit = np.linalg.norm(points - secret.descriptors[owners], axis=1) < EXACT
    yield np.isin(np.arange(len(secret)), owners[hit])


def within(hits: np.ndarray, chosen: np.ndarray) -> str:
    """The share of hits in a part of the descriptors, and how large that part is."""
    return f"{hits[chosen].mean():.3f} of {chosen.mean():.0%}" if chosen.any() else "none"


def secrets() -> Iterator[Features]:
    for source in photographs.list_builtin():
        yield Sift().extract(photographs.read(source.path).pixels, source.path)


# ---- speed


def speed() -> str:
    """Processor time of `recover` alone, of whole photographs; releases of others are made beforehand."""
    lines = [
        "## Milliseconds a descriptor",
        "",
        f"Processor time of the attack alone, by the photograph's keypoints; mean over the first {TIMED_ON} photographs. Not",
        "counted: what is made once, as other users' releases are; and painting, but for `dia`, which does nothing else.",
        "",
        markdown_row(("attack", *(f"dim {dim}" for dim in DIMS))),
        markdown_row(["---"] * (1 + len(DIMS))),
    ]
    everybody = list(zip(photographs.list_builtin(), secrets(), strict=True))[:TIMED_ON]
    spent: dict[str, list[list[float]]] = {name: [[] for _ in DIMS] for name in TIMED}
    with Progress("speed", len(TIMED) * len(DIMS) * len(everybody)) as progress:
        for column, dim in enumerate(DIMS):
            defense = Affine(dim=dim)
            population = others(defense)
            for source, secret in everybody:
                seen = view(defense, secret, population, source.name)
                for name in TIMED:
                    spent[name][column].append(1e3 * seconds(spec.read(name, discovery.ATTACK), seen) / len(secret))
                    progress.advance(note=f"{name}, dim {dim}")
    lines += [markdown_row((f"`{name}`", *(f"{np.mean(values):.2f}" for values in spent[name]))) for name in TIMED]
    return "\n".join([*lines, ""])


def seconds(attack: Attack, seen: View) -> float:
    """Of the processor, for one photograph."""
    seen = replace(seen, notes=[])
    rng = np.random.default_rng(0)
    started = time.process_time()
    if isinstance(attack, DescriptorAttack):
        attack.recover(seen, rng)
    elif isinstance(attack, ImageAttack):
        attack.reconstruct(seen, rng)
    return time.process_time() - started


# ---- views


def view(defense: Defense, secret: Features, population: ReleasePool | None = None, photograph: str = "") -> View:
    """All knowledge that there is, whatever an attack asks for."""
    public = PUBLIC
    knowledge = {
        DefenseDatabase: lambda: DefenseDatabase(words=public.dictionary(Asset("shipped")).words),
        PublicDatabase: lambda: PublicDatabase(words=public.dictionary(Asset("shipped-public")).words),
        PublicAssets: lambda: PublicAssets(assets=public),
        OtherReleases: lambda: OtherReleases(draw=population.without(photograph) if population else lambda count: iter(())),
    }
    release = defense.protect(secret, public, np.random.default_rng(0))
    return View(release=release, defense=defense, extractor=Sift(), knowledge=knowledge)


def others(defense: Affine) -> ReleasePool:
    """Releases of other photographs, as many as an attack asks for at most, made already."""
    population = ReleasePool(photographs.list_builtin(), Sift(), defense, PUBLIC, functools.partial(drawn, defense.dim))
    for source in photographs.list_builtin():
        for _ in population.without(source.name)(800):
            pass
    return population


def drawn(dim: int, *parts: object) -> np.random.Generator:
    return np.random.default_rng([dim, *str(parts).encode()])


PUBLIC = Public()


if __name__ == "__main__":
    main()
