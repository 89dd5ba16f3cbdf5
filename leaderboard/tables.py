"""Records made into tables: one row for each defense and attack; for a terminal, as Markdown, and as CSV."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pandas as pd

from bench.core.hashing import canonical
from bench.mechanisms.composition import DELTA, UNCOVERED
from bench.registry import discovery
from bench.runner.records import Record, latest

if TYPE_CHECKING:
    from rich.table import Table as RichTable

Configuration = dict[str, Any] | None

NOT_APPLICABLE = "n/a"
# The metrics that come first, in this order; others follow by name.
PAPER = ("mae", "mse", "ssim", "psnr")
FIRST = ("keypoints", *PAPER)
SHARES = "recall_"  # begins the names of metrics that a unit has 1 or 0 of
MEDIANS = ("translation_error", "rotation_error")  # over all units: one without a value, which was not localized, is the worst
SEEDED = "Releases are seeded: they are for measuring, and not private."
COMPOSED = (
    "ε/image: the median over photographs of what their keypoints spend together, by the smaller of basic composition and the "
    f"optimal one at δ = {DELTA:g} (Kairouz, Oh and Viswanath). Not covered: {', '.join(UNCOVERED)}."
)
SHOWN_FAILURES = 10
MOST_DIGITS, LARGE = 1e4, 1e7  # numbers between these are written out
LEFT_TO_FILES = ("MSE", "angle", "l2")  # columns that a terminal has no room for


@dataclass(frozen=True, eq=False)
class Table:
    """A summary of records of one task, dataset and seed.

    `frame` has a row for each cell: defense, attack, photographs (done), failed, the mean of each metric over the photographs
    that have it, or the median over all for `MEDIANS`, Wilson's interval of `SHARES`, epsilon_descriptor, epsilon_image
    (median), log10_true, note. What does not apply is missing, and `note` says why.
    """

    heading: str
    frame: pd.DataFrame
    metrics: tuple[str, ...]
    failures: tuple[str, ...]


def tables(records: Iterable[Record]) -> list[Table]:
    """Summarise the latest records, one table for each task, dataset (with its extractor), seed and condition."""
    groups = _grouped(
        latest(records), lambda record: [record["task"], record.get("task_settings"), record["dataset"], record["seed"]]
    )
    return [_table(part) for group in groups for part in _by_condition(group)]


def units_of(task: str, count: int) -> str:
    """What the records of a task are about, in words."""
    noun = _UNITS.get(task, "photograph")
    return noun if count == 1 else {"query": "queries"}.get(noun, noun + "s")


_UNITS: Mapping[str, str] = {"localization": "query", "structure": "scene", "matching": "image pair"}


def labels(pairs: Sequence[tuple[Configuration, Configuration]]) -> list[tuple[str, str]]:
    """Short names for defenses and attacks, `ldp:epsilon=10,subset_size=2`; with digests only where pairs would look alike."""
    short = [(_label(defense), _label(attack)) for defense, attack in pairs]
    written = [canonical(pair) for pair in pairs]
    seen: dict[tuple[str, str], set[str]] = {}
    for names, content in zip(short, written, strict=True):
        seen.setdefault(names, set()).add(content)
    return [
        (_label(defense, digests=True), _label(attack, digests=True)) if len(seen[names]) > 1 else names
        for (defense, attack), names in zip(pairs, short, strict=True)
    ]


def to_markdown(table: Table) -> str:
    """The table with its heading, the metrics' directions and the failures."""
    shown = rendered(table)
    lines = [
        f"**{table.heading}**",
        "",
        markdown_row(shown.columns),
        markdown_row("---" for _ in shown.columns),
        *(markdown_row(row) for row in shown.itertuples(index=False)),
        "",
        *(f"- {line}" for line in (*explanations(table), *_failures(table))),
    ]
    return "\n".join(lines) + "\n"


def to_csv(found: Sequence[Table]) -> str:
    """All tables in one, with full precision; the heading is a column."""
    frames = [table.frame.assign(heading=table.heading) for table in found]
    return pd.concat(frames).to_csv(index=False, na_rep=NOT_APPLICABLE, lineterminator="\n")


def to_rich(table: Table, *, foldable: bool = False) -> RichTable:
    """The table for a terminal: the paper's metrics and what was recovered of descriptors; notes stand beneath, by number.

    `foldable` labels may be broken between fields, and can no longer be copied into a command.
    """
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = rendered(table).drop(columns=list(LEFT_TO_FILES), errors="ignore")
    notes = [note for note in dict.fromkeys(shown.pop("note")) if note]
    numbers = {note: f" [{number}]" for number, note in enumerate(notes, start=1)}
    shown["attack"] += [numbers.get(note, "") for note in table.frame["note"]]
    lines = [f"[{number}] {note}" for number, note in enumerate(notes, start=1)]
    caption = "\n".join((*lines, *_failures(table), COMPOSED, SEEDED))
    drawn = RichTable(title=Text(table.heading), caption=Text(caption), title_justify="left", caption_justify="left")
    for column in shown.columns:
        drawn.add_column(column, overflow="fold", justify="left" if column in ("defense", "attack") else "right")
    for row in shown.itertuples(index=False):
        drawn.add_row(*(Text(spaced(cell) if foldable else cell) for cell in row))
    return drawn


def spaced(label: str) -> str:
    """A label that can be broken between fields."""
    return label.replace(":", ": ").replace(",", ", ")


def rendered(table: Table) -> pd.DataFrame:
    """The frame as text, as people read it."""
    frame = table.frame
    plain = frame[["defense", "attack"]].assign(n=frame["photographs"].map(_count))
    if (frame["failed"] > 0).any():
        plain["failed"] = frame["failed"].map(_count)
    for name in table.metrics:
        plain[_heading(name)] = frame[name].map(number) + _ends(frame, name)
    plain["ε/descriptor"] = frame["epsilon_descriptor"].map(number)
    plain["ε/image"] = frame["epsilon_image"].map(number)
    plain["Pr(true)"] = frame["log10_true"].map(chance)
    plain["note"] = frame["note"]
    return plain


def _ends(frame: pd.DataFrame, name: str) -> pd.Series | str:
    """Of a share, in brackets behind it, its interval."""
    if f"{name}_low" not in frame:
        return ""
    low, high = (frame[f"{name}_{end}"].map(number) for end in ("low", "high"))
    return (" [" + low + ", " + high + "]").where(frame[name].notna(), "")


def _heading(name: str) -> str:
    if name in PAPER:
        return name.upper()
    return f"median {name}" if name in MEDIANS else name


def explanations(table: Table) -> list[str]:
    """What the numbers are, in lines."""
    known = {metric.name(): metric for metric in discovery.everything(discovery.METRIC)}
    lines = [f"{name}: {known[name].description()}" for name in table.metrics if name in known]
    return [*lines, COMPOSED, SEEDED]


def extractor_label(configuration: dict[str, Any]) -> str:
    """An extractor's name, and whether its descriptors are upright or oriented where that is a question."""
    words = {True: " upright", False: " oriented"}
    return configuration["name"] + words.get(configuration.get("upright"), "")  # type: ignore[arg-type]


def _by_condition(records: list[Record]) -> list[list[Record]]:
    """Records of units of one condition each, with those that hold for every unit."""
    conditions = dict.fromkeys(record.get("condition") for record in records if record["status"] != "n/a") or {None: None}
    return [
        [record for record in records if record["status"] == "n/a" or record.get("condition") == condition]
        for condition in conditions
    ]


def _told(records: list[Record]) -> str:
    """Under which condition, where there is one."""
    conditions = {record["condition"] for record in records if record.get("condition") is not None}
    return f" by {conditions.pop()}" if conditions else ""


def _table(records: list[Record]) -> Table:
    first = records[0]
    units = {record["unit"] for record in records if record["status"] != "n/a"}
    dataset = first["dataset"]
    judged = f"{len(units)} {units_of(first['task'], len(units))}{_told(records)}"
    heading = (
        f"{first['task'].capitalize()} on {dataset['name']} ({judged}), "
        f"{extractor_label(dataset['extractor'])} features, seed {first['seed']}"
    )
    cells = _grouped(records, lambda record: [record["defense"], record["attack"], record["run_hash"]])
    metrics = _metric_names(records)
    names = labels([(cell[0]["defense"], cell[0]["attack"]) for cell in cells])
    rows = [_row(cell, *pair, metrics) for cell, pair in zip(cells, names, strict=True)]
    frame = pd.DataFrame(rows).astype({"photographs": "Int64", "failed": "Int64"})
    failures = tuple(
        f"{record['unit']}, {defense}, {attack}: {record['reason']}"
        for cell, (defense, attack) in zip(cells, names, strict=True)
        for record in cell
        if record["status"] == "failed"
    )
    return Table(heading, frame, metrics, failures)


def _row(cell: list[Record], defense: str, attack: str, metrics: Sequence[str]) -> dict[str, Any]:
    done = [record for record in cell if record["status"] == "ok"]
    privacy = cell[0]["privacy"]
    return {
        "defense": defense,
        "attack": attack,
        "photographs": None if cell[0]["status"] == "n/a" else len(done),
        "failed": None if cell[0]["status"] == "n/a" else len(cell) - len(done),
        **{
            column: value
            for name in metrics
            for column, value in _summary(name, [record["metrics"][name] for record in done if name in record["metrics"]]).items()
        },
        "epsilon_descriptor": _float(privacy["epsilon_descriptor"]),
        "epsilon_image": _median(spent(record["privacy"]) for record in done),
        "log10_true": _float(privacy["log10_true"]),
        "note": "; ".join(_notes(cell)),
    }


def _notes(cell: list[Record]) -> list[str]:
    """Why the cell does not apply, or what all its photographs share."""
    if cell[0]["status"] == "n/a":
        return [cell[0]["reason"]]
    done = [record for record in cell if record["status"] == "ok"]
    uncovered = [part for part in cell[0]["privacy"].get("uncovered", ()) if part not in UNCOVERED]
    shared = [note for note in (done[0]["notes"] if done else []) if all(note in record["notes"] for record in done)]
    beyond = [f"not covered either: {', '.join(uncovered)}"] if uncovered else []
    by_distance = cell[0]["privacy"].get("epsilon_per_distance")
    other = [] if by_distance is None else [f"another promise than ε-LDP: ε = {number(by_distance)} per unit of distance"]
    return [*other, *shared, *beyond] if done else ["no photograph could be done"]


def spent(privacy: dict[str, Any]) -> float | None:
    """The smaller of what the two compositions say; older records have one alone."""
    known = [float(privacy[name]) for name in ("epsilon_image", "epsilon_image_optimal") if privacy.get(name) is not None]
    return min(known, default=None)


def _metric_names(records: list[Record]) -> tuple[str, ...]:
    """Of the metrics, those that some record has a value of."""
    found = {name for record in records for name, value in record["metrics"].items() if value is not None}
    return (*(name for name in FIRST if name in found), *sorted(found - set(FIRST)))


def _grouped(records: Iterable[Record], key: Callable[[Record], Any]) -> list[list[Record]]:
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(canonical(key(record)), []).append(record)
    return list(groups.values())


def _label(configuration: Configuration, *, digests: bool = False) -> str:
    if configuration is None:
        return "none needed"
    shown = [
        f"{name}={setting(value)}" for name, value in configuration.items() if name != "name" and (digests or _telling(value))
    ]
    return configuration["name"] + (":" + ",".join(shown) if shown else "")


def _telling(value: Any) -> bool:
    return (
        not isinstance(value, dict)
        and value is not None
        and value is not False
        and not str(value).startswith(("sha256:", "shipped"))
    )


def setting(value: Any) -> str:
    """The value of a field, shortened."""
    if isinstance(value, dict):
        return _label(value, digests=True)
    if isinstance(value, float):
        return f"{value:g}"
    return value.removeprefix("sha256:")[:8] if str(value).startswith("sha256:") else str(value)


def _failures(table: Table) -> list[str]:
    more = len(table.failures) - SHOWN_FAILURES
    return [f"failed: {line}" for line in table.failures[:SHOWN_FAILURES]] + ([f"and {more} more"] if more > 0 else [])


def _float(value: float | str | None) -> float:
    return math.nan if value is None else float(value)


def _known(values: Iterable[float | str | None]) -> pd.Series:
    return pd.Series([float(value) for value in values if value is not None], dtype=float)


def _mean(values: Iterable[float | str | None]) -> float:
    return float(_known(values).mean())


def _median(values: Iterable[float | str | None]) -> float:
    return float(_known(values).median())


def _summary(name: str, values: list[float | None]) -> dict[str, float]:
    """The columns of a metric: its average, and of a share of units the ends of its interval."""
    if name in MEDIANS:
        return {name: _median(math.inf if value is None else value for value in values)}
    if not name.startswith(SHARES) or not values:
        return {name: _mean(values)}
    from leaderboard.intervals import proportion  # which imports this file

    share = proportion([value for value in values if value is not None])
    return {name: share.mean, f"{name}_low": share.low, f"{name}_high": share.high}


def _count(value: Any) -> str:
    return NOT_APPLICABLE if pd.isna(value) else str(value)


def number(value: float) -> str:
    """Four digits, and more before the point than that if it must be; a missing number is n/a."""
    if math.isnan(value) or math.isinf(value):
        return NOT_APPLICABLE if math.isnan(value) else "∞"
    return f"{value:.0f}" if MOST_DIGITS <= abs(value) < LARGE else f"{value:.4g}"


def chance(log10: float) -> str:
    """A probability from its decimal logarithm, which may be far below what a float can hold."""
    if math.isnan(log10):
        return NOT_APPLICABLE
    return f"{10**log10:.4g}" if log10 > -5 else f"10^{log10:.1f}"


def markdown_row(cells: Iterable[Any]) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
