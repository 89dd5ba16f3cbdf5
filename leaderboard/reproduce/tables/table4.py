"""Table 4: direct inversion of LDP-Feat, over |K|, ε and m, and a comparison with attacks on subspaces (Table 1)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.registry import discovery
from leaderboard.reproduce import published, scale
from leaderboard.reproduce.claims import Claim, TableEntry, about_equal, falling, greater, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import (
    Measure,
    Row,
    Table,
    build_baseline_rows,
    build_identification_measures,
    build_oracle_row,
    build_plugin,
    build_reconstruction,
    build_rows_as_printed,
)
from leaderboard.reproduce.tables import table1

PRINTED = ("mae", "ssim", "psnr")
BLOCKS = ((256_000, 1), (256_000, 2), (256_000, 4), (512_000, 4))  # |K|, m
LARGEST = max(size for size, _ in BLOCKS)  # |K|; a smaller dictionary is its first words
EPSILONS = (16, 14, 12, 10)
COMPARED = ("database", "clustering", "dia")
MIN_DIFFERENCE = 0.03  # SSIM; entries that differ by less count as equal


def build_rows(setting: Setting) -> tuple[Row, ...]:
    materials, task, factor = setting.materials, build_reconstruction(setting), setting.profile.scale
    dia = build_plugin(discovery.ATTACK, "dia", {"weights": materials.ldp_network})
    rows = []
    _check_size(setting)
    for line in published.read_rows("table4_ldp_inversion"):
        size, epsilon, subset = int(line["database_size"]), int(line["epsilon"]), int(line["subset_size"])
        words, shifted = scale.words(size, factor), scale.epsilon(epsilon, factor)
        used = 0 if size == LARGEST else words  # 0: the whole dictionary, as in the networks' training
        labels = {"attack": "dia", "|K|": f"{size:,}", "ε": f"{epsilon}", "m": f"{subset}"}
        labels |= {"our |K|": f"first {words:,}" if used else f"{words:,}", "our ε": f"{shifted:.4g}"}
        configuration = {"epsilon": shifted, "subset_size": subset, "words": used, "dictionary": materials.dictionary}
        rows.append(
            Row(
                name=format_name(size, epsilon, subset),
                labels=labels,
                paper=published.parse_numbers(line, PRINTED),
                defense=build_plugin(discovery.DEFENSE, "ldp", configuration),
                attack=dia,
                task=task,
            )
        )
    printed = materials.as_printed_ldp
    return tuple(each for row in rows for each in (row, build_oracle_row(row), *build_rows_as_printed(row, printed)))


def _check_size(setting: Setting) -> None:
    dictionary, factor = setting.materials.dictionary, setting.profile.scale
    available, required = len(Public().dictionary(dictionary)), scale.words(LARGEST, factor)
    if available != required:
        raise UserError(
            f"table4: the dictionary {dictionary} has {available:,} words, and profile {setting.profile.name} needs {required:,} "
            f"({factor:g} times the paper's {LARGEST:,}); make one by `bench dictionary build`, and pass it by --dictionary"
        )


def build_reference_rows(setting: Setting) -> tuple[Row, ...]:
    compared = tuple(row for row in table1.build_rows(setting) if row.labels["attack"] in COMPARED)
    return (*build_baseline_rows(build_reconstruction(setting)), *compared)


def format_name(size: int, epsilon: int, subset: int) -> str:
    return f"|K| {size // 1000}k, ε {epsilon}, m {subset}"


def build_entry(size: int, epsilon: int, subset: int) -> TableEntry:
    return format_name(size, epsilon, subset), "ssim"


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    own = {(format_name(size, epsilon, subset), "ssim") for size, subset in BLOCKS for epsilon in EPSILONS}
    private = [build_entry(size, 10, subset) for size, subset in BLOCKS]
    subsets = {epsilon: [build_entry(256_000, epsilon, subset) for subset in (1, 2, 4)] for epsilon in (16, 10)}
    return (
        same_order({key: value for key, value in paper.items() if key in own}, MIN_DIFFERENCE, "SSIM"),
        Claim(
            text="DIA gets worse as ε falls, for each |K| and m.",
            statements=tuple(
                statement
                for size, subset in BLOCKS
                for statement in falling([build_entry(size, epsilon, subset) for epsilon in EPSILONS])
            ),
        ),
        Claim(text="At ε = 16 DIA gets worse as m grows (|K| = 256k).", statements=falling(subsets[16])),
        Claim(
            text=f"At ε = 10 DIA is flat in m (|K| = 256k): within {MIN_DIFFERENCE:g} SSIM.",
            statements=tuple(about_equal(one, other, MIN_DIFFERENCE) for one, other in itertools.combinations(subsets[10], 2)),
        ),
        Claim(
            text="DIA on LDP at ε = 10 is worse than the database and the clustering attack on subspaces of every dimension.",
            statements=tuple(
                greater(table1.build_entry(attack, dim), own_entry)
                for attack in ("database", "clustering")
                for dim in table1.DIMS
                for own_entry in private
            ),
        ),
        Claim(
            text="DIA on LDP at ε = 10 is worse than DIA on subspaces of dimension 2 and 4.",
            statements=tuple(greater(table1.build_entry("dia", dim), own_entry) for dim in (2, 4) for own_entry in private),
        ),
        Claim(
            text=f"DIA on LDP at ε = 10 equals DIA on subspaces of dimension 8, to within {MIN_DIFFERENCE:g} SSIM.",
            statements=tuple(about_equal(own_entry, table1.build_entry("dia", 8), MIN_DIFFERENCE) for own_entry in private),
        ),
        Claim(
            text="DIA on LDP at ε = 10 is better than DIA on subspaces of dimension 16.",
            statements=tuple(greater(own_entry, table1.build_entry("dia", 16)) for own_entry in private),
        ),
    )


TABLE = Table(
    name="table4",
    title="Table 4: direct inversion of LDP-Feat",
    measures={
        "mae": Measure(metric="mae", digits=4),
        "ssim": Measure(metric="ssim", digits=4),
        **build_identification_measures(),
        "psnr": Measure(metric="psnr", digits=2),
    },
    build_rows=build_rows,
    build_claims=build_claims,
    rank_measure="ssim",
    build_reference_rows=build_reference_rows,
    notes=(
        "The same network inverts all rows. Where |K| is scaled by s, ε is shifted by ln s: the chance that the true word is "
        "released stays the paper's, the guarantee is that of our ε.",
        "Our smaller |K| has the dictionary's first words, a random sample of its clusters, because the networks are trained "
        "with them. The paper clusters each |K|, which brings words closer to descriptors.",
        "The rows `oracle` are not in the paper: a reference that knows which words are true reconstructs from them alone. What "
        "an attacker learns by selecting words lies between `dia` and `oracle`.",
        "The shipped network for LDP-Feat has more training than the one for subspaces, and a context model. So a claim that "
        "LDP-Feat leaks less cannot rest on a weaker attacker.",
    ),
)
