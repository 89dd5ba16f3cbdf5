"""Builds tables of the records of a run, with a row for each defense and attack: for a terminal, report.md and report.csv."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.core.hashing import canonical_json
from bench.core.table import NOT_APPLICABLE, Column, Row, Table
from bench.mechanisms.composition import DELTA, UNCOVERED
from bench.registry import discovery
from bench.runner.records import Record, keep_latest
from bench.task_api import REJECTED
from leaderboard.chance import (
    IDENTIFICATION,
    explain_identification,
    label_bits,
    label_identified,
    label_rank_1,
    name_bits,
    name_rank_1,
)

if TYPE_CHECKING:
    from leaderboard.intervals import Interval
    from leaderboard.signal import Signal

Configuration = dict[str, Any] | None

PAPER_METRICS = ("mae", "mse", "ssim", "psnr")
# The metrics that come first, in this order. The others follow by name. Those that rank defenses are side by side.
FIRST_METRICS = ("keypoints", "mae", "mse", "ssim", *IDENTIFICATION, "psnr")
FRACTION_PREFIX = "recall_"  # of metrics that are 1 or 0 for each sample
MEDIAN_METRICS = ("translation_error", "rotation_error")  # over all samples; one without a value was not localized: the worst
SEED_REMARK = "Releases are seeded: they are for measuring, and not private."
COMPOSITION_REMARK = (
    "ε/image: the median over photographs of the total ε of their keypoints, by the smaller of basic composition and optimal "
    f"composition at δ = {DELTA:g} (Kairouz, Oh and Viswanath). Not covered: {', '.join(UNCOVERED)}."
)
MAX_FAILURES = 10  # failures that are listed
MOST_DIGITS, LARGE = 1e4, 1e7  # numbers between these are written with all digits
FILE_ONLY_COLUMNS = ("MSE", "angle", "identity-distance", "l2")  # a terminal has no room for them


def build_tables(records: Iterable[Record], *, brief: bool = False, foldable: bool = False) -> list[Table]:
    """Return a table of the latest records for each task, dataset (with its extractor), seed and condition.

    A row has the mean of each metric over the photographs that have it, or the median over all photographs for `MEDIAN_METRICS`.
    Fractions have Wilson's interval. A metric of identification also has the fraction of photographs of rank 1, and bits. Values
    that do not apply are missing, and a note gives the reason.

    A `brief` table is for a terminal: it lacks `FILE_ONLY_COLUMNS`, has numbered notes, and has the three values of a metric of
    identification in one column. In a `foldable` table, the labels have
    line breaks between fields, so they cannot be copied into a command.
    """
    groups = _group_by(
        keep_latest(records), lambda record: [record["task"], record.get("task_settings"), record["dataset"], record["seed"]]
    )
    return [_build_table(part, brief, foldable) for group in groups for part in _split_by_condition(group)]


def name_samples(task: str, count: int) -> str:
    """Return the noun for the samples of a task, in singular or plural."""
    noun = _NOUNS.get(task, "photograph")
    return noun if count == 1 else {"query": "queries"}.get(noun, noun + "s")


_NOUNS: Mapping[str, str] = {"localization": "query", "structure": "scene", "matching": "image pair"}


def build_labels(pairs: Sequence[tuple[Configuration, Configuration]]) -> list[tuple[str, str]]:
    """Return short names of defenses and attacks, such as `ldp:epsilon=10,subset_size=2`. Equal names get digests as well."""
    short = [(_label(defense), _label(attack)) for defense, attack in pairs]
    contents: dict[tuple[str, str], set[str]] = {}
    for names, pair in zip(short, pairs, strict=True):
        contents.setdefault(names, set()).add(canonical_json(pair))
    return [
        (_label(defense, digests=True), _label(attack, digests=True)) if len(contents[names]) > 1 else names
        for (defense, attack), names in zip(pairs, short, strict=True)
    ]


def add_breaks(label: str) -> str:
    """Return a label that can be broken between fields."""
    return label.replace(":", ": ").replace(",", ", ")


def label_extractor(configuration: dict[str, Any]) -> str:
    """Return an extractor's name, followed by "upright" or "oriented" if that is one of its settings."""
    words = {True: " upright", False: " oriented"}
    return configuration["name"] + words.get(configuration.get("upright"), "")  # type: ignore[arg-type]


def _split_by_condition(records: list[Record]) -> list[list[Record]]:
    """Return the records of each condition, with the n/a records, which hold for all samples."""
    conditions = dict.fromkeys(record.get("condition") for record in records if record["status"] != "n/a") or {None: None}
    return [
        [record for record in records if record["status"] == "n/a" or record.get("condition") == condition]
        for condition in conditions
    ]


def _build_table(records: list[Record], brief: bool, foldable: bool) -> Table:
    experiments = _group_by(records, lambda record: [record["defense"], record["attack"], record["run_hash"]])
    labels = build_labels([(records[0]["defense"], records[0]["attack"]) for records in experiments])
    metrics = _list_metrics(records)
    signals = _judge_signals(experiments)
    rows = [_collect_values(*each, metrics) for each in zip(experiments, labels, signals, strict=True)]
    columns = {"defense": "defense", "attack": "attack", "photographs": "n"}
    if any(row["failed"] for row in rows):
        columns["failed"] = "failed"
    for name in metrics:
        columns[name] = _label_metric(name)
        if name in IDENTIFICATION and not brief:
            columns |= {name_rank_1(name): label_rank_1(name), name_bits(name): label_bits(name)}
    columns |= {"epsilon_descriptor": "ε/descriptor", "epsilon_image": "ε/image", "log10_true": "Pr(true)"}
    if brief:
        columns = {name: label for name, label in columns.items() if label not in FILE_ONLY_COLUMNS}
    else:
        columns["note"] = "note"
    heading = _describe_samples(records)
    failures = _list_failures(experiments, labels)
    chance = [explain_identification(name) for name in metrics if name in IDENTIFICATION]
    remarks = [*_count_values(records, metrics), *_list_signal_remarks(signals), COMPOSITION_REMARK, SEED_REMARK]
    return Table(
        heading=heading,
        columns=tuple(Column(label=label, text=name in ("defense", "attack", "note")) for name, label in columns.items()),
        rows=tuple(
            Row(
                texts=tuple(
                    _format_identification(name, row)
                    if brief and name in IDENTIFICATION
                    else _format_value(name, row[name], foldable)
                    for name in columns
                ),
                values=row | {"heading": heading},
                note=row["note"] if brief else "",
            )
            for row in rows
        ),
        remarks=(*failures, *chance, *remarks) if brief else (*_explain_metrics(metrics), *chance, *remarks, *failures),
        note_column=1,  # the attack
    )


def _describe_samples(records: list[Record]) -> str:
    """Return the heading: task, dataset, samples, condition, extractor and seed."""
    first = records[0]
    count = len({record["sample"] for record in records if record["status"] != "n/a"})
    condition = next((f" by {record['condition']}" for record in records if record.get("condition") is not None), "")
    return (
        f"{first['task'].capitalize()} on {first['dataset']['name']} ({count} {name_samples(first['task'], count)}{condition}), "
        f"{label_extractor(first['dataset']['extractor'])} features, seed {first['seed']}"
    )


def _judge_signals(experiments: Sequence[list[Record]]) -> list[Signal | None]:
    """Return the signal of each experiment; None for the experiments of tasks that return no image."""
    if not any(record["attack"] and record["metrics"] for records in experiments for record in records):
        return [None] * len(experiments)
    from leaderboard.signal import judge_experiments  # expensive: imports scipy

    return judge_experiments(experiments)


def _list_signal_remarks(signals: Sequence[Signal | None]) -> list[str]:
    """Return the remarks on the rule, and on the baselines that are missing."""
    if not any(signals):
        return []
    from leaderboard.signal import REMARK, explain_untested  # expensive: imports scipy

    untested = explain_untested(signals)
    return [REMARK, *([untested] if untested else [])]


def _collect_values(
    records: list[Record], labels: tuple[str, str], signal: Signal | None, metrics: Sequence[str]
) -> dict[str, Any]:
    """Return the values of an experiment's row by name. Values that do not apply are None."""
    completed = [record for record in records if record["status"] == "ok"]
    applies, privacy = records[0]["status"] != "n/a", records[0]["privacy"]
    return {
        "defense": labels[0],
        "attack": labels[1],
        "photographs": len(completed) if applies else None,
        "failed": len(records) - len(completed) if applies else None,
        **_average_metrics(completed, metrics),
        "epsilon_descriptor": _to_float(privacy["epsilon_descriptor"]),
        "epsilon_image": _median(spent_epsilon(record["privacy"]) for record in completed),
        "log10_true": _to_float(privacy["log10_true"]),
        "signal": signal.text if signal else None,
        "note": "; ".join(_list_notes(records, completed, signal)),
    }


def _format_value(name: str, value: Any, foldable: bool) -> str:
    if isinstance(value, str):
        return add_breaks(value) if foldable and name in ("defense", "attack") else value
    if value is None or isinstance(value, int):
        return NOT_APPLICABLE if value is None else str(value)
    if name == "log10_true":
        return format_chance(value)
    if isinstance(value, float):
        return format_number(value)
    return format_fraction(value) if name in map(name_rank_1, IDENTIFICATION) else format_interval(value)


def _format_identification(name: str, row: Mapping[str, Any]) -> str:
    """Return the three values of a metric of identification, for a column of a terminal."""
    if row[name] is None:
        return NOT_APPLICABLE
    bits: Interval = row[name_bits(name)]
    return f"{row[name]:.2f}, {count_hits(row[name_rank_1(name)])}\n{bits.mean:.1f} bits [{bits.low:.1f}, {bits.high:.1f}]"


def _label_metric(name: str) -> str:
    if name in PAPER_METRICS:
        return name.upper()
    if name in IDENTIFICATION:
        return label_identified(name)
    return f"median {name}" if name in MEDIAN_METRICS else name


def _explain_metrics(metrics: Sequence[str]) -> list[str]:
    """Return the descriptions of all metrics but those of identification, which have a remark."""
    plugins = {plugin.name(): plugin for plugin in discovery.load_plugins(discovery.METRIC)}
    return [f"{name}: {plugins[name].description()}" for name in metrics if name in plugins and name not in IDENTIFICATION]


def _count_values(records: list[Record], metrics: Sequence[str]) -> Iterator[str]:
    """Yield the number of samples with a value, for each metric of an extra or program that some samples have no value of."""
    extras = {plugin.name() for plugin in discovery.load_plugins(discovery.METRIC) if plugin.packages or plugin.programs}
    for name in metrics:
        if name in extras:
            values = [(record["sample"], record["metrics"].get(name)) for record in records if record["status"] == "ok"]
            every, known = {sample for sample, _ in values}, {sample for sample, value in values if value is not None}
            if known != every:
                samples = f"{len(known)} of {len(every)} {name_samples(records[0]['task'], 2)}"
                yield f"{name}: over the {samples} that have a value{_count_objects(records, name)}."


def _count_objects(records: list[Record], name: str) -> str:
    """Return the number of objects, such as faces, in all samples, by the notes of a metric; empty without such notes."""
    pattern = re.compile(rf"{re.escape(name)}: (\w+) in the photograph: (\d+)")
    matches = [(record["sample"], match) for record in records for note in record["notes"] if (match := pattern.fullmatch(note))]
    counts = {sample: int(match[2]) for sample, match in matches}  # the notes of all experiments on a sample are equal
    return f", with {sum(counts.values()):,} {matches[0][1][1]}" if matches else ""


def _list_notes(records: list[Record], completed: list[Record], signal: Signal | None) -> list[str]:
    """Return the reason why the experiment does not apply, or that it has no signal and the notes that hold for all its samples.

    The reason why an experiment was not tested for a signal is in the table's remarks.
    """
    if records[0]["status"] == "n/a":
        return [records[0]["reason"]]
    if not completed:
        return ["every sample failed"]
    uncovered = [part for part in records[0]["privacy"].get("uncovered", ()) if part not in UNCOVERED]
    shared = [note for note in completed[0]["notes"] if all(note in record["notes"] for record in completed)]
    beyond = [f"also not covered: {', '.join(uncovered)}"] if uncovered else []
    by_distance = records[0]["privacy"].get("epsilon_per_distance")
    other = [] if by_distance is None else [f"not ε-LDP: ε = {format_number(by_distance)} per unit of distance"]
    at_baseline = [signal.text] if signal and signal.is_absent else []
    return [*at_baseline, *other, *list_rejected(completed), *shared, *beyond]


def list_rejected(completed: Sequence[Record]) -> list[str]:
    """Return a note on the number of queries that were rejected for their intrinsics, if there are any."""
    count = sum(any(note.startswith(REJECTED) for note in record["notes"]) for record in completed)
    return [f"{count} of {len(completed)} queries rejected for their intrinsics: not localized"] if count else []


def _list_failures(experiments: Sequence[list[Record]], labels: Sequence[tuple[str, str]]) -> list[str]:
    failures = [
        f"failed: {record['sample']}, {defense}, {attack}: {record['reason']}"
        for records, (defense, attack) in zip(experiments, labels, strict=True)
        for record in records
        if record["status"] == "failed"
    ]
    more = len(failures) - MAX_FAILURES
    return failures[:MAX_FAILURES] + ([f"and {more} more"] if more > 0 else [])


def spent_epsilon(privacy: dict[str, Any]) -> float | None:
    """Return the smaller ε of an image of the two compositions. Older records have only one of them."""
    known = [float(privacy[name]) for name in ("epsilon_image", "epsilon_image_optimal") if privacy.get(name) is not None]
    return min(known, default=None)


def _list_metrics(records: list[Record]) -> tuple[str, ...]:
    """Return the metrics with a value in at least one record."""
    names = {name for record in records for name, value in record["metrics"].items() if value is not None}
    return (*(name for name in FIRST_METRICS if name in names), *sorted(names - set(FIRST_METRICS)))


def _group_by(records: Iterable[Record], key: Callable[[Record], Any]) -> list[list[Record]]:
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(canonical_json(key(record)), []).append(record)
    return list(groups.values())


def _label(configuration: Configuration, *, digests: bool = False) -> str:
    if configuration is None:
        return "none needed"
    if "parts" in configuration:
        return "+".join(_label(part, digests=digests) for part in configuration["parts"])
    settings = [
        f"{name}={format_setting(value)}"
        for name, value in configuration.items()
        if name != "name" and (digests or _is_distinctive(value))
    ]
    return configuration["name"] + (":" + ",".join(settings) if settings else "")


def _is_distinctive(value: Any) -> bool:
    return (
        not isinstance(value, dict)
        and value is not None
        and value is not False
        and not str(value).startswith(("sha256:", "shipped"))
    )


def format_setting(value: Any) -> str:
    """Return the value of a field, shortened."""
    if isinstance(value, dict):
        return _label(value, digests=True)
    if isinstance(value, float):
        return f"{value:g}"
    return value.removeprefix("sha256:")[:8] if str(value).startswith("sha256:") else str(value)


def _to_float(value: float | str | None) -> float | None:
    return None if value is None else float(value)


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _average_metrics(completed: Sequence[Record], metrics: Sequence[str]) -> dict[str, float | Interval | None]:
    """Return the averages of all metrics over the samples that have them, by name; those of identification have three."""
    averages: dict[str, float | Interval | None] = {}
    for name in metrics:
        values = [record["metrics"][name] for record in completed if name in record["metrics"]]
        averages |= _summarize_ranks(name, values) if name in IDENTIFICATION else {name: _average(name, values)}
    return averages


def _summarize_ranks(name: str, values: Sequence[float | None]) -> dict[str, float | Interval | None]:
    """Return the mean reciprocal rank, the fraction of rank 1, and the bits."""
    from leaderboard.identification import summarize_identification  # expensive: imports scipy

    known = [float(value) for value in values if value is not None]
    if not known:
        return {name: None, name_rank_1(name): None, name_bits(name): None}
    summary = summarize_identification(known)
    return {name: summary.reciprocal.mean, name_rank_1(name): summary.rank_1, name_bits(name): summary.bits}


def _average(name: str, values: list[float | None]) -> float | Interval | None:
    """Return the average of a metric over the samples. A fraction of samples comes with its interval."""
    from leaderboard.intervals import proportion  # expensive: imports scipy

    if name in MEDIAN_METRICS:
        return _median(math.inf if value is None else float(value) for value in values)
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    return proportion(known) if name.startswith(FRACTION_PREFIX) else float(np.mean(known))


def format_number(value: float) -> str:
    """Return a number with four digits, or more before the decimal point if needed. NaN is n/a."""
    if math.isnan(value) or math.isinf(value):
        return NOT_APPLICABLE if math.isnan(value) else "∞"
    return f"{value:.0f}" if MOST_DIGITS <= abs(value) < LARGE else f"{value:.4g}"


def format_interval(value: Interval) -> str:
    """Return a mean with its interval; a mean alone if the interval is infinite."""
    ends = f" [{format_number(value.low)}, {format_number(value.high)}]" if math.isfinite(value.low) else ""
    return format_number(value.mean) + ends


def format_fraction(value: Interval) -> str:
    """Return a fraction with its interval and the number of hits.

    >>> from leaderboard.intervals import proportion
    >>> format_fraction(proportion([1, 0, 0, 1]))
    '0.5 [0.15, 0.85] (2 of 4)'
    """
    return f"{format_interval(value)} ({count_hits(value)})"


def count_hits(value: Interval) -> str:
    """Return the number of hits of a fraction, such as "2 of 4". As a mean over seeds, it need not be an integer."""
    return f"{format_number(round(value.mean * value.count, 1))} of {value.count}"


def format_chance(log10: float) -> str:
    """Return a probability as text, from its decimal logarithm. It may be too small for a float."""
    return f"{10**log10:.4g}" if log10 > -5 else f"10^{log10:.1f}"
