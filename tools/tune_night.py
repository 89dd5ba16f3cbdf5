"""Recall without privacy by night, over settings of `hard-night`, to choose settings that are as hard as the paper's night.

The paper localizes 24.6% to 50.3% of the queries by night within 0.25 m and 2 degrees without privacy (Table S1). Only raw
descriptors are measured, on a gallery of another seed than that of the tables, so that no result depends on the choice. With two
of five rooms and 120 of 300 references, references are as dense as in the tables.

    python tools/tune_night.py --noise 1 2 4 8 --blur 1 2 4 --viewpoint 1 2
"""

from __future__ import annotations

import argparse
import itertools

import bench
from bench.datasets.hard_night import HardNight
from bench.tasks.localization import Localization
from defenses.none import Undefended

SEED, VIEWS, ROOMS = 1, 120, 2
TRIALS = 3000  # of RANSAC; raw descriptors need fewer


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("noise", "blur", "viewpoint"):
        parser.add_argument(f"--{name}", type=float, nargs="+", default=[1.0])
    parser.add_argument("--queries", type=int, default=40)
    args = parser.parse_args()
    print("| viewpoint | noise | blur | recall in %: 0.25 m, 2° | 0.5 m, 5° | 5 m, 10° | inliers |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for viewpoint, noise, blur in itertools.product(args.viewpoint, args.noise, args.blur):
        dataset = HardNight(
            seed=SEED, views=VIEWS, rooms=ROOMS, queries=args.queries, night=1.0, viewpoint=viewpoint, noise=noise, blur=blur
        )
        records = bench.run([Undefended()], task=Localization(trials=TRIALS), dataset=dataset)
        names = ("recall_0.25m_2deg", "recall_0.5m_5deg", "recall_5m_10deg", "inliers")
        # A query that failed, such as one without a keypoint, is not localized either.
        strict, middle, wide, inliers = (
            sum(each["metrics"].get(name) or 0.0 for each in records) / len(records) for name in names
        )
        recalls = " | ".join(f"{100 * recall:.1f}" for recall in (strict, middle, wide))
        print(f"| {viewpoint:g} | {noise:g} | {blur:g} | {recalls} | {inliers:.0f} |", flush=True)


if __name__ == "__main__":
    main()
