"""Table 4: direct inversion of LDP-Feat, over |K|, ε and m; and how it compares with attacks on subspaces (Table 1)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.registry import discovery
from leaderboard.reproduce import published, scale
from leaderboard.reproduce.claims import Cell, Claim, about_equal, falling, greater, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Measure, Row, Table, build, reconstruction
from leaderboard.reproduce.tables import table1

PRINTED = ("mae", "ssim", "psnr")
BLOCKS = ((256_000, 1), (256_000, 2), (256_000, 4), (512_000, 4))  # |K|, m
LARGEST = max(size for size, _ in BLOCKS)  # |K|; a smaller one is its first words
EPSILONS = (16, 14, 12, 10)
COMPARED = ("database", "clustering", "dia")
APART = 0.03  # SSIM; two cells nearer to each other than this are called about equal


def rows(setting: Setting) -> tuple[Row, ...]:
    materials, task, factor = setting.materials, reconstruction(setting), setting.profile.scale
    dia = build(discovery.ATTACK, "dia", {"weights": materials.ldp_network})
    found = []
    _check_size(setting)
    for line in published.lines("table4_ldp_inversion"):
        size, epsilon, subset = int(line["database_size"]), int(line["epsilon"]), int(line["subset_size"])
        words, shifted = scale.words(size, factor), scale.epsilon(epsilon, factor)
        used = 0 if size == LARGEST else words  # all of the dictionary, which is what its networks are told
        labels = {"|K|": f"{size:,}", "ε": f"{epsilon}", "m": f"{subset}", "our |K|": f"{words:,}", "our ε": f"{shifted:.4g}"}
        given = {"epsilon": shifted, "subset_size": subset, "words": used, "dictionary": materials.dictionary}
        found.append(
            Row(
                name=name(size, epsilon, subset),
                labels=labels,
                paper=published.numbers(line, PRINTED),
                defense=build(discovery.DEFENSE, "ldp", given),
                attack=dia,
                task=task,
            )
        )
    return tuple(found)


def _check_size(setting: Setting) -> None:
    dictionary, factor = setting.materials.dictionary, setting.profile.scale
    have, wanted = len(Public().dictionary(dictionary)), scale.words(LARGEST, factor)
    if have != wanted:
        raise UserError(
            f"table4: the dictionary {dictionary} has {have:,} words, and profile {setting.profile.name} needs {wanted:,} "
            f"({factor:g} times the paper's {LARGEST:,}); make one with bench dictionary build, and name it with --dictionary"
        )


def borrowed(setting: Setting) -> tuple[Row, ...]:
    return tuple(row for row in table1.rows(setting) if row.labels["attack"] in COMPARED)


def name(size: int, epsilon: int, subset: int) -> str:
    return f"|K| {size // 1000}k, ε {epsilon}, m {subset}"


def cell(size: int, epsilon: int, subset: int) -> Cell:
    return name(size, epsilon, subset), "ssim"


def claims(paper: Mapping[Cell, float]) -> tuple[Claim, ...]:
    own = {(name(size, epsilon, subset), "ssim") for size, subset in BLOCKS for epsilon in EPSILONS}
    private = [cell(size, 10, subset) for size, subset in BLOCKS]
    subsets = {epsilon: [cell(256_000, epsilon, subset) for subset in (1, 2, 4)] for epsilon in (16, 10)}
    return (
        same_order({key: value for key, value in paper.items() if key in own}, APART, "SSIM"),
        Claim(
            text="DIA gets worse as ε falls, for each |K| and m.",
            statements=tuple(
                statement
                for size, subset in BLOCKS
                for statement in falling([cell(size, epsilon, subset) for epsilon in EPSILONS])
            ),
        ),
        Claim(text="At ε = 16 DIA gets worse as m grows (|K| = 256k).", statements=falling(subsets[16])),
        Claim(
            text=f"At ε = 10 DIA is flat in m (|K| = 256k): within {APART:g} SSIM.",
            statements=tuple(about_equal(one, other, APART) for one, other in itertools.combinations(subsets[10], 2)),
        ),
        Claim(
            text="LDP at ε = 10 lies under the database and the clustering attack on subspaces, at every dimension.",
            statements=tuple(
                greater(table1.cell(attack, dim), own_cell)
                for attack in ("database", "clustering")
                for dim in table1.DIMS
                for own_cell in private
            ),
        ),
        Claim(
            text="LDP at ε = 10 lies under DIA on subspaces of dimension 2 and 4.",
            statements=tuple(greater(table1.cell("dia", dim), own_cell) for dim in (2, 4) for own_cell in private),
        ),
        Claim(
            text=f"LDP at ε = 10 equals DIA on subspaces of dimension 8, to within {APART:g} SSIM.",
            statements=tuple(about_equal(own_cell, table1.cell("dia", 8), APART) for own_cell in private),
        ),
        Claim(
            text="LDP at ε = 10 lies above DIA on subspaces of dimension 16.",
            statements=tuple(greater(own_cell, table1.cell("dia", 16)) for own_cell in private),
        ),
    )


TABLE = Table(
    name="table4",
    title="Table 4: direct inversion of LDP-Feat",
    measures={
        "mae": Measure(metric="mae", digits=4),
        "ssim": Measure(metric="ssim", digits=4),
        "psnr": Measure(metric="psnr", digits=2),
    },
    rows=rows,
    claims=claims,
    ordered="ssim",
    borrowed=borrowed,
    notes=(
        "The same network paints all rows. Where |K| is scaled by s, ε is shifted by ln s: the chance that the true word is "
        "released stays the paper's, the guarantee is that of our ε.",
    ),
)
