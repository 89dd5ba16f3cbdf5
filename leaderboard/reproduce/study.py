"""What a table of the paper is to us: rows, each with the cell of ours that answers it, and claims about them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from bench.api import Asset, Attack, Dataset, Defense, Extractor, Plugin, Task
from bench.extractors.sift import Sift
from bench.registry import discovery, fields, spec
from bench.registry.discovery import Kind
from bench.tasks.reconstruction import Reconstruction
from leaderboard.reproduce.claims import Cell, Claim
from leaderboard.reproduce.profiles import Profile, Setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from leaderboard.reproduce.drawing import Scene

P = TypeVar("P", bound=Plugin)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of a table of the paper, and our defense, attack and task for it."""

    name: str  # what claims call it
    labels: Mapping[str, str]  # what people read, by column
    paper: Mapping[str, float]  # measure -> the paper's value
    defense: Defense
    attack: Attack | None  # None where the task judges the release itself
    task: Task


@dataclass(frozen=True, kw_only=True)
class Measure:
    """Something that a row is judged by: a metric of the records, in the paper's unit."""

    metric: str
    times: float = 1.0  # from our unit to the paper's
    digits: int = 3  # shown after the point
    condition: str | None = None  # of the units that count, if not all do
    share: bool = False  # whether each unit has 1 or 0 of it
    median: bool = False  # whether it is the median over units, of which one without a value is the worst, and not their mean


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the paper. `name` is what the command calls it."""

    name: str
    title: str
    measures: Mapping[str, Measure]
    rows: Callable[[Setting], tuple[Row, ...]]
    claims: Callable[[Mapping[Cell, float]], tuple[Claim, ...]]  # given the paper's values of all cells
    place: Callable[[Profile], Dataset] | None = None  # that it is about, unless another is named; None for photographs
    extractor: Callable[[Profile], Extractor] = lambda profile: Sift()  # of its features, unless another is named
    repeated: bool = False  # whether its rows are done with as many seeds as the profile says
    ordered: str | None = None  # the measure by which paper's and our rows are ranked
    # Rows of other tables that claims compare with.
    borrowed: Callable[[Setting], tuple[Row, ...]] = field(default=lambda setting: ())
    draw: Callable[[Scene], Iterator[tuple[str, Figure]]] | None = None  # figures that come with it, as those of a `Drawing`
    notes: tuple[str, ...] = ()


def printed(rows: tuple[Row, ...]) -> dict[Cell, float]:
    """The paper's values by cell."""
    return {(row.name, measure): value for row in rows for measure, value in row.paper.items()}


def reconstruction(setting: Setting) -> Reconstruction:
    """The task of Tables 1 and 4: recovered descriptors are painted by the network for raw ones."""
    network = setting.materials.raw_network
    return Reconstruction() if network == Asset("shipped") else Reconstruction(inverter=f"dia:weights={network}")


def build(kind: Kind[P], name: str, given: Mapping[str, Any], where_there_are: Mapping[str, Any] | None = None) -> P:
    """The plugin of that name with the fields `given`, and with those others that it has."""
    plugin = discovery.lookup(kind, name)
    types = fields.field_types(plugin)
    return spec.build(plugin, {**given, **{field: value for field, value in (where_there_are or {}).items() if field in types}})
