"""Measures every attack at the same settings, and where the stronger ones fail, and writes docs/results/attacks.md.

    python tools/measure_attacks.py --data ../shared/data --work work/attacks

1. All attacks on the same releases of the whole built-in photographs: recovered descriptors and images, and the difference from
   the strongest attack of the paper.
2. Descriptors found exactly, for a database of centres (the shipped one) and for one of raw descriptors, and by the number of
   zeros of the descriptor.
3. Milliseconds of one core per descriptor.

Records in WORK are reused, and the results of 2. and 3. are cached for each photograph, so an interrupted run resumes.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from result_page import cache_arrays, format_interval, write_page

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
from bench.images.photographs import Source
from bench.registry import discovery, spec
from bench.runner.other_releases import ReleasePool
from bench.runner.records import Record
from bench.settings import Asset
from bench.threat_model import DefenseDatabase, OtherReleases, PublicAssets, PublicDatabase
from bench.types import Features, Subspaces
from defenses.affine import Affine
from leaderboard.intervals import interval

TITLE = """# Results of every attack

The releases are of the seven built-in photographs: all keypoints, upright SIFT, seed 0. The attacks have their default settings,
[chosen on other photographs](tuning.md). In brackets: 95% intervals of Student's t over photographs.
"""
DIMS = (2, 4, 8, 16)
SUBSPACES = tuple(f"affine:dim={dim}" for dim in DIMS)
WORD_SETS = tuple(f"ldp:epsilon={epsilon},subset_size=2" for epsilon in (16, 12, 10))
# The first is the reference.
ON_SUBSPACES = ("database", "clustering", "dia", "nearest", "lattice", "repeat", "sparsity", "intersection", "keypoints")
ON_WORD_SETS = ("dia", "context", "repeat", "repeat:releases=4", "keypoints")
TIMED_ON = 2  # photographs
TIMED = ("database", "clustering", "nearest", "lattice", "sparsity", "intersection", "dia")
Results = Mapping[tuple[str, str], Sequence[Record]]  # defense, attack -> records
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
    results = {
        (defense, attack): run(defense, attack, args.work)
        for defenses, attacks in ((SUBSPACES, ON_SUBSPACES), (WORD_SETS, ON_WORD_SETS))
        for defense in defenses
        for attack in attacks
    }
    parts = [
        TITLE,
        write_comparison("Subspaces", SUBSPACES, ON_SUBSPACES, "recovered", results),
        write_comparison("Word sets", WORD_SETS, ON_WORD_SETS, "ssim", results),
        write_exact(build_raw_database(args.data, args.work)),
        write_speed(),
    ]
    write_page("attacks.md", "\n".join(parts), (record for records in results.values() for record in records))


# ---- all attacks at the same settings


def write_comparison(title: str, defenses: Sequence[str], attacks: Sequence[str], by: str, results: Results) -> str:
    """Write a table of every attack against every defense, with paired differences from the first attack in the metric `by`."""
    lines = [
        f"## {title}",
        "",
        "*recovered*: fraction of descriptors to which the estimate is nearer than to any other descriptor of the photograph. "
        f"*angle*: from the true descriptor to the estimate, in degrees. *difference*: {by} minus that of `{attacks[0]}` on the "
        "same photographs. *notes*: of the attack, on the first photograph.",
        "",
        markdown_row(("defense", "attack", "recovered", "angle", "SSIM", "PSNR", "difference", "notes")),
        markdown_row(["---"] * 8),
    ]
    highest = []
    for written in defenses:
        first = list_values(results[written, attacks[0]], by)
        for attack in attacks:
            records = results[written, attack]
            values = list_values(records, by)
            apart = "" if attack == attacks[0] or not len(values) else format_interval(interval(values - first), 3)
            columns = [format_values(records, metric, digits) for metric, digits in SHOWN.items()]
            lines.append(markdown_row((f"`{written}`", f"`{attack}`", *columns, apart, join_notes(records))))
        means = {attack: values.mean() for attack in attacks if len(values := list_values(results[written, attack], by))}
        highest.append(f"`{max(means, key=lambda attack: means[attack])}` at `{written}`")
    return "\n".join([*lines, "", f"Highest {by}: {', '.join(highest)}.", ""])


def run(defense: str, attack: str, work: Path) -> list[Record]:
    print(defense, attack, flush=True)
    return bench.run([spec.read(defense, discovery.DEFENSE)], [spec.read(attack, discovery.ATTACK)], out=work)


def list_values(records: Sequence[Record], metric: str) -> np.ndarray:
    """List the values of a metric. -> (photographs,), empty if it does not apply"""
    return np.array([value for record in records if (value := record["metrics"].get(metric)) is not None])


def format_values(records: Sequence[Record], metric: str, digits: int) -> str:
    values = list_values(records, metric)
    return format_interval(interval(values), digits) if len(values) else "n/a"


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
    fractions = [markdown_row(("dim", *COLUMNS)), markdown_row(["---"] * (1 + len(COLUMNS)))]
    zeros = [markdown_row(("dim", *ZEROS)), markdown_row(["---"] * (1 + len(ZEROS)))]
    secrets = extract_all()
    for dim in DIMS:
        results = []  # of each photograph
        for source, secret in secrets.items():
            inputs = [dim, source.content_hash(), *(PUBLIC.digest(database) for database in ("shipped", raw))]
            results.append(cache_arrays("measure_attacks", inputs, functools.partial(find_exact, dim, secret, raw)))
        means = np.array([[hits[column].mean() for column in COLUMNS] for hits in results])
        fractions.append(markdown_row((dim, *(format_interval(interval(column), 3) for column in means.T))))
        hit = np.concatenate([hits[COLUMNS[0]] for hits in results])
        beyond = np.concatenate([(secret.descriptors == 0).sum(axis=1) for secret in secrets.values()]) - dim
        parts = [(beyond >= low) & (beyond <= high) for low, high in ZEROS.values()]
        zeros.append(markdown_row((dim, *(format_fraction(hit, part) for part in parts))))
        print(fractions[-1], zeros[-1], sep="\n", flush=True)
    return "\n".join(
        [
            "## Descriptors found exactly",
            "",
            f"Fraction of descriptors that `sparsity` and `lattice` find to within {EXACT:g}. Both use the release alone.",
            f"The shipped database holds centres of clusters; that of the columns *raw rows* holds {RAW_ROWS:,} descriptors.",
            "*candidates*: the descriptor is among the points that `lattice` finds, whether or not it is the estimate.",
            "",
            *fractions,
            "",
            "`sparsity`, shipped database, by the number of the descriptor's zeros minus the dimension of the subspace. Entries:",
            "the fraction found of these descriptors, and their fraction of all. Without such zeros a descriptor is no",
            "degenerate vertex, and the attack cannot find it.",
            "",
            *zeros,
            "",
        ]
    )


def find_exact(dim: int, secret: Features, raw: Asset) -> dict[str, np.ndarray]:
    """Return which descriptors are found, by COLUMNS. -> (N,) bool each"""
    hits = []
    for database, parts in ((Asset("shipped"), 16), (raw, 1)):
        view = create_view(Affine(dim=dim, database=database, sub_databases=parts), secret)
        for attack in (Sparsity(), Lattice()):
            estimates = attack.recover(view, np.random.default_rng(0))
            hits.append(np.linalg.norm(estimates - secret.descriptors, axis=1) < EXACT)
    assert isinstance(view.release, Subspaces)
    owners, points = find_unit_integer_points(view.release, Lattice.longest)
    exact = np.linalg.norm(points - secret.descriptors[owners], axis=1) < EXACT
    return dict(zip(COLUMNS, [*hits, np.isin(np.arange(len(secret)), owners[exact])], strict=True))


def format_fraction(hits: np.ndarray, subset: np.ndarray) -> str:
    """Format the fraction of hits in a subset of the descriptors, and the size of the subset."""
    return f"{hits[subset].mean():.3f} of {subset.mean():.0%}" if subset.any() else "none"


def extract_all() -> dict[Source, Features]:
    """Extract the features of the built-in photographs."""
    return {source: Sift().extract(photographs.read(source.path).pixels, source) for source in photographs.list_builtin()}


# ---- speed


def write_speed() -> str:
    """Write the processor time of `recover` alone, on whole photographs; other releases are drawn beforehand."""
    lines = [
        "## Milliseconds per descriptor",
        "",
        f"Processor time of the attack divided by the number of keypoints: mean over the first {TIMED_ON} photographs. Image",
        "reconstruction is not included, except for `dia`; nor is work that is done once, such as other users' releases.",
        "",
        markdown_row(("attack", *(f"dim {dim}" for dim in DIMS))),
        markdown_row(["---"] * (1 + len(DIMS))),
    ]
    timed = list(extract_all().items())[:TIMED_ON]
    spent: dict[str, list[list[float]]] = {name: [[] for _ in DIMS] for name in TIMED}
    with Progress("speed", len(TIMED) * len(DIMS) * len(timed)) as progress:
        for column, dim in enumerate(DIMS):
            defense = Affine(dim=dim)
            pool = functools.cache(functools.partial(release_others, defense))
            for source, secret in timed:
                for name in TIMED:
                    attack = spec.read(name, discovery.ATTACK)
                    inputs = [spec.to_json_with_digests(plugin, PUBLIC) for plugin in (defense, attack)]
                    if isinstance(attack, ImageAttack):
                        inputs.append(dict(attack.assets(defense, Sift(), PUBLIC)))
                    compute = functools.partial(measure_seconds, attack, defense, secret, pool, source.name)
                    seconds = cache_arrays("measure_attacks", [source.content_hash(), *inputs], compute)["seconds"]
                    spent[name][column].append(1e3 * float(seconds[0]) / len(secret))
                    progress.advance(note=f"{name}, dim {dim}")
    lines += [markdown_row((f"`{name}`", *(f"{np.mean(values):.2f}" for values in spent[name]))) for name in TIMED]
    return "\n".join([*lines, ""])


def measure_seconds(
    attack: Attack, defense: Affine, secret: Features, pool: Callable[[], ReleasePool], photograph: str
) -> dict[str, np.ndarray]:
    """Return the processor time for one photograph: `seconds`."""
    view = create_view(defense, secret, pool(), photograph)
    rng = np.random.default_rng(0)
    started = time.process_time()
    if isinstance(attack, DescriptorAttack):
        attack.recover(view, rng)
    elif isinstance(attack, ImageAttack):
        attack.reconstruct(view, rng)
    return {"seconds": np.array([time.process_time() - started])}


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
