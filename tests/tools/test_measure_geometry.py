"""The plot of docs/geometry.md: the strongest attack on each defense, without references and baselines."""

from typing import Any

import numpy as np
from measure_geometry import RECALL, draw_tradeoff


def test_the_plot_has_the_strongest_attack() -> None:
    def score(ssim: float, identified: float) -> list[dict[str, dict[str, float]]]:
        return [{"metrics": {"ssim": ssim, "identified": identified}}]

    attacked: dict[tuple[str, str], Any] = {
        ("none", "dia"): score(0.7, 1.0),
        ("lines", "neighbourhood-oracle"): score(0.9, 1.0),
        ("lines", "neighbourhood"): score(0.5, 0.25),
        ("lines", "dia-lines"): [{"metrics": {}}],  # it does not apply
        ("lines", "density"): score(0.4, 0.5),
        ("lines", "blank"): score(0.3, 0.01),
    }
    localized: dict[str, Any] = {
        "none": [{"metrics": {RECALL: 1.0}}, {"metrics": {RECALL: 0.0}}],
        "lines": [{"metrics": {RECALL: 0.0}}],
    }
    figure = draw_tradeoff(attacked, localized)
    single = [[line for line in axes.lines if np.size(line.get_xdata()) == 1] for axes in figure.axes]
    points = [[np.ravel([line.get_xdata(), line.get_ydata()]) for line in lines] for lines in single]
    expected = [[[0.5, 0.7], [0.0, 0.5]], [[0.5, 1.0], [0.0, 0.5]]]
    np.testing.assert_allclose(np.array(points), np.array(expected))
