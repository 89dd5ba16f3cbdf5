"""Table 1: inverting adversarial affine subspaces. Hybrid lifting of dimension 2 to 16, five attacks."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from bench.api import Defense
from bench.registry import discovery
from leaderboard.reproduce import published
from leaderboard.reproduce.claims import Cell, Claim, Statement, at_least, falling, same_order
from leaderboard.reproduce.profiles import Setting
from leaderboard.reproduce.study import Measure, Row, Table, build, reconstruction

PRINTED = ("mae", "ssim", "psnr")
DIMS = (2, 4, 8, 16)
STRONGEST_FIRST = ("database", "clustering", "dia", "nearest")
APART = 0.03  # SSIM by which two cells of the paper must differ for their order to count
SLACK = 0.01  # SSIM by which the lesser side of a ≥ may be ahead
LITTLE = 0.1  # SSIM; the paper's database attack loses .068 from dimension 2 to 16


def rows(setting: Setting) -> tuple[Row, ...]:
    materials, task = setting.materials, reconstruction(setting)
    lines = published.lines("table1_affine_inversion")
    undefended = Row(
        name="raw",
        labels={"attack": "raw", "dim": "n/a"},
        paper=published.numbers(lines[-1], PRINTED),
        defense=build(discovery.DEFENSE, "none", {}),
        attack=build(discovery.ATTACK, "dia", {"weights": materials.raw_network}),
        task=task,
    )
    where_there_are = {"weights": materials.affine_network, "database": materials.public_database, **setting.profile.reduced}
    lifted = [
        Row(
            name=name(line["attack"], line["dim"]),
            labels={"attack": line["attack"], "dim": line["dim"]},
            paper=published.numbers(line, PRINTED),
            defense=lifting(int(line["dim"]), setting),
            attack=build(discovery.ATTACK, line["attack"], {}, where_there_are),
            task=task,
        )
        for line in lines[:-1]
    ]
    return (undefended, *lifted)


def lifting(dim: int, setting: Setting) -> Defense:
    """The paper's hybrid lifting."""
    return build(discovery.DEFENSE, "affine", {"dim": dim, "database": setting.materials.database})


def name(attack: str, dim: int | str) -> str:
    return f"{attack}, dim {dim}"


def cell(attack: str, dim: int) -> Cell:
    return name(attack, dim), "ssim"


def claims(paper: Mapping[Cell, float]) -> tuple[Claim, ...]:
    ssim = {key: value for key, value in paper.items() if key[1] == "ssim"}
    return (
        same_order(ssim, APART, "SSIM"),
        Claim(
            text="raw ≥ database ≥ clustering ≥ DIA ≥ nearest at each dimension, in SSIM.",
            statements=tuple(at_least(one, other, SLACK) for dim in DIMS for one, other in _strongest_first(dim)),
        ),
        Claim(
            text="Quality falls with the dimension, for every attack.",
            statements=tuple(
                statement for attack in STRONGEST_FIRST for statement in falling([cell(attack, dim) for dim in DIMS])
            ),
        ),
        Claim(
            text=f"The database attack loses little up to dimension 16: less than {LITTLE:g} SSIM, and less than the "
            "attacks that do not know the database W.",
            statements=(
                Statement(text=f"[database, dim 2] - [database, dim 16] < {LITTLE:g}", weights=_loss("database"), below=LITTLE),
                *(_loses_less("database", other) for other in ("clustering", "dia", "nearest")),
            ),
        ),
    )


def _strongest_first(dim: int) -> list[tuple[Cell, Cell]]:
    order = [("raw", "ssim"), *(cell(attack, dim) for attack in STRONGEST_FIRST)]
    return list(itertools.pairwise(order))


def _loss(attack: str) -> dict[Cell, float]:
    return {cell(attack, 2): 1.0, cell(attack, 16): -1.0}


def _loses_less(one: str, other: str) -> Statement:
    less = {key: -weight for key, weight in _loss(other).items()}
    return Statement(text=f"{one} loses less than {other} from dim 2 to 16", weights={**_loss(one), **less}, below=0.0)


TABLE = Table(
    name="table1",
    title="Table 1: inverting adversarial affine subspaces",
    measures={
        "mae": Measure(metric="mae", digits=4),
        "ssim": Measure(metric="ssim", digits=4),
        "psnr": Measure(metric="psnr", digits=2),
        "recovered": Measure(metric="recovered", times=100, digits=1),
        "angle": Measure(metric="angle", digits=1),
    },
    rows=rows,
    claims=claims,
    ordered="ssim",
)
