"""Definition of a reproduced table: its rows, each with our corresponding experiment, and the claims about them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from bench.api import Attack, Dataset, Defense, Extractor, Plugin
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.registry import discovery, fields, spec
from bench.registry.discovery import Kind
from bench.settings import Asset
from bench.task_api import Task
from bench.tasks.reconstruction import Reconstruction
from leaderboard.chance import IDENTIFIED, label_bits, label_identified, label_rank_1
from leaderboard.reproduce.claims import Claim, TableEntry
from leaderboard.reproduce.profiles import Profile, Setting
from leaderboard.signal import BASELINES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from leaderboard.reproduce.drawing import FigureData

P = TypeVar("P", bound=Plugin)

AS_PRINTED = "dia, as printed"


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of a table of the paper, with our defense, attack and task for it."""

    name: str  # the name by which claims refer to the row
    labels: Mapping[str, str]  # column -> text
    paper: Mapping[str, float]  # measure -> the paper's value
    defense: Defense
    attack: Attack | None  # None where the task evaluates the release itself
    task: Task


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A column of a table: a metric of the records, in the paper's unit of measurement."""

    metric: str
    factor: float = 1.0  # from our unit of measurement to the paper's
    digits: int = 3  # after the decimal point
    condition: str | None = None  # only samples with this condition count; None: all
    fraction: bool = False  # each sample's value is 0 or 1, and the mean is a fraction
    median: bool = False  # median over samples instead of the mean; a sample without a value counts as the worst
    # of a metric of identification, instead of the mean: the fraction of samples of rank 1, or the bits
    identification: Literal["rank 1", "bits"] | None = None


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the paper. `name` is its name on the command line."""

    name: str
    title: str
    measures: Mapping[str, Measure]
    build_rows: Callable[[Setting], tuple[Row, ...]]
    build_claims: Callable[[Mapping[TableEntry, float]], tuple[Claim, ...]]  # from the paper's values of all entries
    dataset: Callable[[Profile], Dataset] | None = None  # the default; None: the table uses photographs
    extractor: Callable[[Profile], Extractor] = lambda profile: Sift()  # the default
    multiple_seeds: bool = False  # as many seeds as the profile has; otherwise one
    rank_measure: str | None = None  # the measure whose rank correlation with the paper's is reported
    # Baselines, and rows of other tables that claims compare with.
    build_reference_rows: Callable[[Setting], tuple[Row, ...]] = field(default=lambda setting: ())
    draw: Callable[[FigureData], Iterator[tuple[str, Figure]]] | None = None  # yields its figures, as `Drawing.draw` does
    notes: tuple[str, ...] = ()


def build_identification_measures() -> dict[str, Measure]:
    """Return the columns of `identified`: the mean reciprocal rank, the fraction of rank 1, and the bits."""
    return {
        label_identified(): Measure(metric=IDENTIFIED, digits=3),
        label_rank_1(): Measure(metric=IDENTIFIED, digits=2, identification="rank 1"),
        label_bits(): Measure(metric=IDENTIFIED, digits=1, identification="bits"),
    }


def collect_paper_values(rows: tuple[Row, ...]) -> dict[TableEntry, float]:
    """Return the paper's values by table entry."""
    return {(row.name, measure): value for row in rows for measure, value in row.paper.items()}


def build_reconstruction(setting: Setting) -> Reconstruction:
    """Return the task of Tables 1 and 4: the network for raw descriptors inverts the recovered ones."""
    network = setting.materials.raw_network
    return Reconstruction() if network == Asset("shipped") else Reconstruction(inverter=f"dia:weights={network}")


def build_rows_as_printed(row: Row, network: Asset | None) -> list[Row]:
    """Return a row of the same release, attacked by a network that reads it as the paper prints; none without a network.

    Raises
    ------
    UserError
        if `network` is a file of a network that reads another input.
    """
    from bench.inversion import weights

    if network is None:
        return []
    if (encoding := weights.load(Path(network)).meta["encoding"]) != "released":
        raise UserError(f"{network}: its input is {encoding}; pass a network of `bench train --encoding released`")
    attack = build_plugin(discovery.ATTACK, "dia", {"weights": network})
    name = f"{row.name}, as printed"
    return [replace(row, name=name, labels={**row.labels, "attack": AS_PRINTED}, paper={}, attack=attack)]


def build_oracle_row(row: Row) -> Row:
    """Return the row of the same release, reconstructed by a reference that knows the true words, without the paper's values."""
    oracle: Attack = build_plugin(discovery.ATTACK, "oracle", {})
    return replace(row, name=f"{row.name}, oracle", labels={**row.labels, "attack": oracle.name()}, paper={}, attack=oracle)


def build_baseline_rows(task: Task) -> tuple[Row, ...]:
    """Return the rows of the baselines of a table of reconstructions, on features without a defense.

    They serve every defense that releases the positions in the clear (`leaderboard/signal.py`).
    """
    undefended = build_plugin(discovery.DEFENSE, "none", {})
    return tuple(
        Row(
            name=name,
            labels={"attack": name},
            paper={},
            defense=undefended,
            attack=build_plugin(discovery.ATTACK, name, {}),
            task=task,
        )
        for name in BASELINES
    )


def build_plugin(kind: Kind[P], name: str, configuration: Mapping[str, Any], optional: Mapping[str, Any] | None = None) -> P:
    """Return the plugin `name` with the fields of `configuration`, and with those fields of `optional` that it has."""
    plugin = discovery.load_plugin(kind, name)
    types = fields.resolve_types(plugin)
    return spec.build(plugin, {**configuration, **{field: value for field, value in (optional or {}).items() if field in types}})
