"""The curve of repeated releases: the probability that T word sets reveal the true word, and its upper bound at T ε."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bench.mechanisms.multi_release import bound_success, compute_success_chances

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def build_rows(epsilon: float, domain: int, size: int, releases: int) -> list[dict[str, Any]]:
    """Return a row for each T = 1, ..., `releases` of the ω-subset mechanism on |K| = `domain` words with m = `size`.

    `success` is the probability that the word in most sets is the true one. `bound` is the greatest success probability of any
    guess at T ε, and `epsilon_total` is T ε.
    """
    chances = compute_success_chances(epsilon, domain, size, releases)
    return [
        {
            "releases": number,
            "epsilon": epsilon,
            "epsilon_total": number * epsilon,
            "words": domain,
            "subset_size": size,
            "success": chance,
            "bound": bound_success(number * epsilon, domain),
        }
        for number, chance in enumerate(chances, start=1)
    ]


def draw(curve: list[dict[str, Any]]) -> Figure:
    """Draw success and bound over T, for one setting."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 3.4), layout="constrained", dpi=120)
    axes = figure.subplots()
    setting = curve[0]
    numbers = [row["releases"] for row in curve]
    axes.plot(numbers, [row["bound"] for row in curve], "k--", label=r"bound at $T\varepsilon$")
    axes.plot(numbers, [row["success"] for row in curve], "o-", color="tab:blue", label="the word in most sets")
    axes.set_title(
        rf"ldp, $\varepsilon$ = {setting['epsilon']:g}, m = {setting['subset_size']}, |K| = {setting['words']:,}", fontsize=9
    )
    axes.set_xlabel("releases of the same features, T")
    axes.set_ylabel("probability of the true word")
    axes.set_xticks(numbers)
    axes.set_ylim(0, 1.04)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.55, 0.93))
    return figure
