"""Plots of a comparison group. The shape of points and lines differs as well, for grey print and for colour blindness."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from bench.core.hashing import canonical_json
from leaderboard.comparison import ComparisonGroup, GroupedExperiment
from leaderboard.figures import escape_text, lay_out
from leaderboard.intervals import Interval
from leaderboard.measures import PRIVACY, RANKING, Measure, list_measures
from leaderboard.plot_style import PlotStyle, choose_styles, position_labels
from leaderboard.ranking import Standing, average_baselines, rank_defenses
from leaderboard.signal import Verdict
from leaderboard.tables import build_labels, format_setting
from leaderboard.tradeoff import Tradeoff

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRADEOFF = "tradeoff"  # prefix of the plots that the page draws itself
HOLLOW = "hollow: no signal, or not tested"  # in legends
SMALL, LARGE = 6.0, 9.0  # sizes of markers, in points
BASELINE_LINES = ("-", (0, (1, 1.5)))  # line styles, in the order of the baselines
BRIEF = 48  # maximum number of letters of a label
ROW = 0.3  # inches per defense
LETTER = 3.9, 9.0  # width and height of a letter of a label, in points


def draw_plots(group: ComparisonGroup, tradeoffs: Sequence[Tradeoff]) -> Iterator[tuple[str, Figure]]:
    """Yield the name and the figure of each plot of a group with attacks."""
    ranked = rank_defenses(group)
    curves = _collect_curves(ranked)
    for measure in list_measures(RANKING):
        if any(group.average(experiment, measure) for experiment in group.experiments):
            yield _name_plot("attacks", measure), draw_attacks(group, ranked, measure)
            if curves:
                yield _name_plot("epsilon", measure), draw_epsilon(group, curves, measure)
    several = len({tradeoff.utility_group.key for tradeoff in tradeoffs}) > 1
    for tradeoff in tradeoffs:
        key = tradeoff.utility_group.key[:8] if several else None
        yield _name_plot(TRADEOFF, tradeoff.privacy, tradeoff.condition, key), draw_tradeoff(tradeoff)


def draw_tradeoff(tradeoff: Tradeoff) -> Figure:
    """Draw the utility of each defense and setting (x), the score of the strongest attack on it (y), and the Pareto front."""
    figure, axes = _create_axes(7.2, 4.6, tradeoff.caption)
    for family, style in choose_family_styles(tradeoff).items():
        members = [point for point in tradeoff.points if point.standing.configuration["name"] == family]
        for label in dict.fromkeys(label_standing(point.standing, family) for point in members):
            shown = [point for point in members if label_standing(point.standing, family) == label]
            _draw_points(axes, [(point.utility, point.privacy) for point in shown], style, filled=label == family, label=label)
    # For a utility between two settings of the front, the least privacy loss is that of the more useful setting: a step.
    x, y = [point.utility.mean for point in tradeoff.front], [point.privacy.mean for point in tradeoff.front]
    axes.plot(x, y, color="0.35", lw=1, ls=(0, (4, 2)), drawstyle="steps-pre", zorder=1, label="Pareto front")
    _draw_baselines(axes.axhline, tradeoff.baselines)
    axes.set_xlabel(f"{tradeoff.utility.label} →", fontsize=9)
    axes.set_ylabel(f"{tradeoff.privacy.label} of the strongest attack →", fontsize=9)
    axes.margins(0.12)
    axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    lay_out(figure)  # fixes the positions of the points
    _write_settings(axes, tradeoff)
    return figure


def draw_attacks(group: ComparisonGroup, ranked: Sequence[Standing], privacy: Measure) -> Figure:
    """Draw the score of each attack on each defense, one line per defense, with intervals and the baselines as lines.

    The marker of an attack without a signal is hollow, and that of the strongest attack on a defense is large.
    """
    experiments = [experiment for standing in ranked for experiment in standing.experiments]
    names = list(dict.fromkeys(experiment.attack for experiment in experiments if group.average(experiment, privacy)))
    height = ROW * len(ranked) * max(1.0, len(names) / 3)
    figure, axes = _create_axes(
        9.0, 1.2 + height, f"{', '.join([group.title, *group.facts[:3]])}. Large: the strongest attack on that defense"
    )
    for index, (name, style) in enumerate(choose_styles(names).items()):
        offset = (index - (len(names) - 1) / 2) / (len(names) + 1)
        for filled, large in itertools.product((True, False), repeat=2):
            at = [
                (score, Interval(row + offset, -math.inf, math.inf, 1))
                for row, standing in enumerate(ranked)
                for experiment in standing.experiments
                if experiment.attack == name and (experiment is standing.represent(privacy)) == large
                if _has_signal(group, experiment) == filled
                if (score := group.average(experiment, privacy))
            ]
            _draw_points(axes, at, style, filled=filled, label=None, size=LARGE if large else SMALL)
        axes.plot([], [], style.marker, color=style.colour, label=_shorten(name))
    axes.plot([], [], "o", color="0.35", mfc="white", label=HOLLOW)
    _draw_baselines(axes.axvline, average_baselines(group, privacy))
    axes.set_yticks(range(len(ranked)), [_label_standing(standing) for standing in ranked], fontsize=8)
    axes.set_ylim(len(ranked) - 0.5, -0.5)
    axes.set_xlabel(f"{privacy.label} →", fontsize=9)
    axes.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def draw_epsilon(group: ComparisonGroup, curves: Mapping[str, Sequence[Standing]], privacy: Measure) -> Figure:
    """Draw the score of the strongest attack over the ε of a descriptor. It is hollow where it has no signal."""
    figure, axes = _create_axes(5.6, 3.6, ", ".join([group.title, *group.facts[:3]]))
    complete = True  # whether each point has a signal
    for (label, curve), style in zip(curves.items(), choose_styles(curves).values(), strict=True):
        attacks = [(_get_epsilon(standing), standing.represent(privacy)) for standing in curve]
        points = [
            (epsilon, score, _has_signal(group, attack))
            for epsilon, attack in attacks
            if attack and (score := group.average(attack, privacy))
        ]
        at, scores = [epsilon for epsilon, _, _ in points], [score for _, score, _ in points]
        axes.plot(
            at,
            [score.mean for score in scores],
            color=style.colour,
            marker=style.marker,
            ls=style.line,
            ms=5,
            lw=1.3,
            label=_shorten(label),
        )
        hollow = [(epsilon, score.mean) for epsilon, score, evident in points if not evident]
        complete = complete and not hollow
        axes.plot([x for x, _ in hollow], [y for _, y in hollow], style.marker, color=style.colour, mfc="white", ms=5, zorder=3)
        low, high = [score.low for score in scores], [score.high for score in scores]
        if all(map(math.isfinite, low)):
            axes.fill_between(at, low, high, color=style.colour, alpha=0.12, lw=0)
    if not complete:
        axes.plot([], [], "o", color="0.35", mfc="white", label=HOLLOW)
    _draw_baselines(axes.axhline, average_baselines(group, privacy))
    axes.set_xlabel("ε of a descriptor", fontsize=9)
    axes.set_ylabel(f"{privacy.label} of the strongest attack", fontsize=9)
    axes.legend(fontsize=7, frameon=False)
    return figure


def _name_plot(kind: str, measure: Measure, *parts: str | None) -> str:
    """Return the name of a plot's file. That of the first measure has no part for it."""
    return "-".join(filter(None, (kind, None if measure.name == PRIVACY else measure.name, *parts)))


def label_standing(standing: Standing, family: str) -> str:
    """Return the legend of a defense: its family, and why it has no rank."""
    if standing.rank is not None:
        return family
    return f"{family}, {'no signal' if standing.signal and standing.signal.is_absent else 'unranked'}"


def choose_family_styles(tradeoff: Tradeoff) -> dict[str, PlotStyle]:
    """Return the style of each family of defenses."""
    return choose_styles(sorted({point.standing.configuration["name"] for point in tradeoff.points}))


def label_points(tradeoff: Tradeoff) -> list[str]:
    """Return the label of each point, such as `ldp ε 10`: the defense's name, and its fields that differ among the points."""
    configurations = [point.standing.configuration for point in tradeoff.points]
    texts = []
    for configuration in configurations:
        family = configuration["name"]
        members = [other for other in configurations if other["name"] == family]
        differing = [name for name in configuration if len({canonical_json(other.get(name)) for other in members}) > 1]
        fields = (f"{'ε' if name == 'epsilon' else name} {format_setting(configuration[name])}" for name in differing)
        texts.append(" ".join([family, *fields]))
    return texts


def _collect_curves(ranked: Sequence[Standing]) -> dict[str, list[Standing]]:
    """Return groups of at least two settings that differ in ε alone, by their label without ε. Each is in the order of ε.

    A setting is in a group if it has a rank, or none only because its attacks have no signal.
    """
    curves: dict[str, list[Standing]] = {}
    for standing in ranked:
        has_curve = standing.rank is not None or (
            standing.signal is not None and standing.unranked_reason == standing.signal.text
        )
        if has_curve and math.isfinite(_get_epsilon(standing)):
            fixed = {name: value for name, value in standing.configuration.items() if name != "epsilon"}
            curves.setdefault(build_labels([(fixed, None)])[0][0], []).append(standing)
    return {label: sorted(curve, key=_get_epsilon) for label, curve in curves.items() if len(set(map(_get_epsilon, curve))) > 1}


def _get_epsilon(standing: Standing) -> float:
    value = standing.experiments[0].metadata["privacy"]["epsilon_descriptor"]
    return math.nan if value is None else float(value)


def _create_axes(width: float, height: float, title: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    axes = figure.subplots()
    axes.set_title(escape_text(title), fontsize=8, loc="left", wrap=True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.25, lw=0.5)
    axes.set_axisbelow(True)
    return figure, axes


def _has_signal(group: ComparisonGroup, experiment: GroupedExperiment) -> bool:
    signal = group.signals.get(experiment)
    return signal is not None and signal.verdict is Verdict.SIGNAL


def _draw_baselines(draw_line: Callable[..., object], baselines: Mapping[str, float]) -> None:
    """Draw the score of each baseline as a line across the axes, with a label for the legend."""
    for (name, score), line in zip(baselines.items(), BASELINE_LINES, strict=False):
        draw_line(score, color="0.35", lw=1, ls=line, zorder=1, label=f"baseline {name}")


def _draw_points(
    axes: Axes,
    at: Sequence[tuple[Interval, Interval]],
    style: PlotStyle,
    *,
    filled: bool,
    label: str | None,
    size: float = SMALL,
) -> None:
    """Draw the points, with thin lines for the intervals that are finite."""
    if not at:
        return
    across, up = [x for x, _ in at], [y for _, y in at]
    axes.errorbar(
        [value.mean for value in across],
        [value.mean for value in up],
        xerr=_error_bars(across),
        yerr=_error_bars(up),
        fmt=style.marker,
        color=style.colour,
        mfc=style.colour if filled else "white",
        ms=size,
        lw=0.7,
        label=label and _shorten(label),
        zorder=3,
    )


def _error_bars(values: Sequence[Interval]) -> tuple[list[float], list[float]]:
    low = [value.mean - value.low if math.isfinite(value.low) else 0.0 for value in values]
    return [max(0.0, one) for one in low], [max(0.0, v.high - v.mean) if math.isfinite(v.high) else 0.0 for v in values]


def _write_settings(axes: Axes, tradeoff: Tradeoff) -> None:
    """Write the labels of the points where there is room."""
    size = (axes.bbox.width * 72 / axes.figure.dpi, axes.bbox.height * 72 / axes.figure.dpi)  # in points
    means = [(point.utility.mean, point.privacy.mean) for point in tradeoff.points]
    within = axes.transAxes.inverted().transform(axes.transData.transform(means))  # (n, 2) from 0 to 1
    points = [(x * size[0], (1 - y) * size[1]) for x, y in within]
    texts = label_points(tradeoff)
    sizes = [(LETTER[0] * min(len(text), BRIEF), LETTER[1]) for text in texts]
    for text, position in zip(texts, position_labels(points, sizes, size), strict=True):
        if position:
            left, up = position[0] / size[0], 1 - position[1] / size[1]
            axes.text(left, up, _shorten(text), fontsize=7, color="0.2", va="center", transform=axes.transAxes)


def _label_standing(standing: Standing) -> str:
    return _shorten(f"{standing.rank}  {standing.defense}" if standing.rank is not None else f"unranked  {standing.defense}")


def _shorten(text: str) -> str:
    """Return the text, shortened to BRIEF letters."""
    return escape_text(text if len(text) <= BRIEF else text[: BRIEF - 1] + "…")
