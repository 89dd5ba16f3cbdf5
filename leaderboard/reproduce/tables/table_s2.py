"""Table S2: structure from motion from releases alone, over m, at one |K| and one ε; with a picture of each model.

The paper has two scenes, South Building and Fountain. Ours is compared with both. Mapping and releases are random, so each row
runs with several seeds. Intervals are over seeds, and they hold for this scene alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from bench.api import Defense, Extractor
from bench.extractors.sift import Sift
from bench.tasks.structure import Structure
from leaderboard.figures import Panel, draw
from leaderboard.reproduce import published, scenes
from leaderboard.reproduce.claims import Claim, Statement, TableEntry, falling, greater, same_order
from leaderboard.reproduce.drawing import FigureData
from leaderboard.reproduce.profiles import Profile, Setting
from leaderboard.reproduce.run import select_records
from leaderboard.reproduce.scenes import ALL_DESCRIPTORS
from leaderboard.reproduce.study import Measure, Row, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bench.datasets.walk import Walk

COMPARED_SCENE, OTHER_SCENE = "South Building", "Fountain"  # compared with our scene; in a separate column
IMAGES = 128.0  # of South Building
WORDS = "512000"
SUBSETS = (4, 8, 16, 32, 64)
BEST = 32
RAW = "raw"
SEPARATOR = "; "  # between the name of a row and its mapper and matching, if they are not the profile's first
NEAR_BEST = 0.9  # a value above this fraction of the best counts as equal
MIN_DIFFERENCE = 5000.0  # points of South Building
PRINTED = {"registered": "registered_images", "points": "sparse_points"}  # our measure -> the paper's column
PRINTED |= {name: name for name in ("track_length", "reprojection_error")}


def build_rows(setting: Setting) -> tuple[Row, ...]:
    """Return the rows of the profile's first mapper and matching. The claims rest on them, except for the number of cameras."""
    mapper, matching = setting.profile.walk_variants[0]
    lines = published.read_rows("tableS2_sfm")
    compared, others = ([line for line in lines if line["scene"] == scene] for scene in (COMPARED_SCENE, OTHER_SCENE))
    task = Structure(images=setting.profile.walk.views, mapper=mapper, matching=matching)
    return tuple(
        Row(
            name=format_name(line["dictionary_size"], line["epsilon"], int(line["subset_size"])),
            labels={"mapper": mapper, "matching": matching}
            | build_labels(setting, line)
            | {OTHER_SCENE: " · ".join(other[column] for column in PRINTED.values())},
            paper={"images": IMAGES} | {measure: float(line[column]) for measure, column in PRINTED.items()},
            defense=build_defense(setting, line["dictionary_size"], line["epsilon"], int(line["subset_size"])),
            attack=None,
            task=task,
        )
        for line, other in zip(compared, others, strict=True)
    )


def build_reference_rows(setting: Setting) -> tuple[Row, ...]:
    """Return the rows of the other mappers and matchings. Raw descriptors have no words, so they have one row for each mapper."""
    first, *others = setting.profile.walk_variants
    mappers = {first[0]}
    variants = []
    for mapper, matching in others:
        for row in build_rows(setting):
            if row.name == RAW and mapper in mappers:
                continue
            if matching == "descriptors" and int(row.labels["m"]) > setting.profile.walk_max_matched:
                continue
            variants.append(
                replace(
                    row,
                    name=f"{row.name}{SEPARATOR}{mapper}, {matching}",
                    labels={**row.labels, "mapper": mapper, "matching": matching},
                    task=Structure(images=setting.profile.walk.views, mapper=mapper, matching=matching),
                )
            )
        mappers.add(mapper)
    return tuple(variants)


def build_labels(setting: Setting, line: Mapping[str, str]) -> dict[str, str]:
    return scenes.build_labels(
        setting, line["dictionary_size"], line["epsilon"], int(line["subset_size"]), setting.profile.walk_scale
    )


def build_defense(setting: Setting, size: str, epsilon: str, subset: int) -> Defense:
    return scenes.build_defense(setting, size, epsilon, subset, factor=setting.profile.walk_scale)


def format_name(size: str, epsilon: str, subset: int) -> str:
    """Return the name of a row, by which claims refer to it."""
    if size == ALL_DESCRIPTORS:
        return RAW
    return "no privacy" if epsilon == "inf" else f"m {subset}"


def build_claims(paper: Mapping[TableEntry, float]) -> tuple[Claim, ...]:
    def private(measure: str) -> list[TableEntry]:
        return [(f"m {subset}", measure) for subset in SUBSETS]

    raw, quantised, best = ((row, "points") for row in (RAW, "no privacy", f"m {BEST}"))
    variants: dict[str, list[str]] = {}  # mapper and matching, "" for the profile's first -> names of rows
    for row, measure in paper:
        if measure == "images":
            variants.setdefault(row.partition(SEPARATOR)[2], []).append(row)
    return (
        same_order(
            {entry: value for entry, value in paper.items() if entry[1] == "points" and SEPARATOR not in entry[0]},
            MIN_DIFFERENCE,
            "points of South Building",
        ),
        Claim(text="Quantisation alone, without privacy, loses points.", statements=(greater(raw, quantised),)),
        Claim(
            text="Privacy loses more: every m has fewer points than quantisation alone.",
            statements=tuple(greater(quantised, entry) for entry in private("points")),
        ),
        Claim(
            text=f"An interior m is near best: m = {BEST} has more points than m = 4 and 8, over {NEAR_BEST:.0%} of any other's.",
            statements=(
                *(greater(best, entry) for entry in private("points")[:2]),
                *(state_near_best(best, entry) for entry in private("points")[2:] if entry != best),
            ),
        ),
        *(
            Claim(
                text=f"Most cameras are registered in every row{f' of {variant}' if variant else ''}: more than half.",
                statements=tuple(state_most_registered(row) for row in rows),
            )
            for variant, rows in variants.items()
        ),
        Claim(
            text="Tracks get shorter: raw descriptors have the longest, and every m shorter ones than quantisation alone.",
            statements=(
                *falling([("raw", "track_length"), ("no privacy", "track_length")]),
                *(greater(("no privacy", "track_length"), entry) for entry in private("track_length")),
            ),
        ),
        Claim(
            text="The remaining points are not worse: the reprojection error of raw descriptors is the greatest.",
            statements=tuple(
                greater(("raw", "reprojection_error"), entry)
                for entry in [("no privacy", "reprojection_error"), *private("reprojection_error")]
            ),
        ),
    )


def state_near_best(one: TableEntry, other: TableEntry) -> Statement:
    """Return the statement one > NEAR_BEST · other."""
    text = f"[{one[0]}] {one[1]} > {NEAR_BEST:.0%} of [{other[0]}] {other[1]}"
    return Statement(text=text, weights={one: 1.0, other: -NEAR_BEST}, above=0.0)


def state_most_registered(row: str) -> Statement:
    text = f"[{row}] registered > half of images"
    return Statement(text=text, weights={(row, "registered"): 1.0, (row, "images"): -0.5}, above=0.0)


def select_walk(profile: Profile) -> Walk:
    return profile.walk


def build_extractor(profile: Profile) -> Extractor:
    return Sift(max_keypoints=profile.walk_keypoints)


PANEL_METRICS = {"registered": "registered", "right": "right_poses", "points": "points"}


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    """Yield a figure with an image of the scene, and with the models of the first seed seen from above."""
    rows = build_rows(data.setting)
    sample = next(record["sample"] for row in rows for record in select_records(data.result, row.name))
    panels = [Panel(original, name, "") for name, original in itertools.islice(data.load_originals(), 1)]
    panels += [data.build_panel(row.name, sample, row.name, PANEL_METRICS, digits=0) for row in rows]
    yield "models", draw(panels, f"Structure from motion of {sample} from above; red wedges show viewing directions", 4)


TABLE = Table(
    name="tableS2",
    title="Table S2: structure from motion",
    measures={
        "images": Measure(metric="images", digits=0),
        "registered": Measure(metric="registered", digits=1),
        "right_poses": Measure(metric="right_poses", digits=1),
        "points": Measure(metric="points", digits=0),
        "track_length": Measure(metric="track_length", digits=2),
        "reprojection_error": Measure(metric="reprojection_error", digits=2),
        "verified_pairs": Measure(metric="verified_pairs", digits=0),
    },
    build_rows=build_rows,
    build_claims=build_claims,
    build_reference_rows=build_reference_rows,
    dataset=select_walk,
    extractor=build_extractor,
    multiple_seeds=True,
    rank_measure="points",
    draw=draw_figures,
    notes=(
        f"The paper's values are those of {COMPARED_SCENE}, of {IMAGES:.0f} images; the column {OTHER_SCENE} has its other "
        "scene, of 11: registered · points · track length · reprojection error.",
        "Right poses are images within 5% of the scene's extent and 5° of their true poses, up to one similarity.",
        "Where |K| is scaled by s, ε is shifted by ln s: the chance that the true word is released stays the paper's, the "
        "guarantee is that of our ε. The dictionary is from images of the scene that are not mapped.",
        "Matching: unique-words, by words that are unique in both images; words, by all words that both images release; "
        "descriptors, by words with mutually nearest descriptors. `--profile dense` has up to 8,192 keypoints per "
        "image, both mappers and all matchings, descriptors up to m = 4.",
        "Intervals are over seeds, of releases and of mapping, in this one scene; n counts the seeds with a model.",
    ),
)
