"""The data of the paper that a reproduction lacks, and the commands that download them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from bench.formats.published import DATASETS

# Options of each table whose default is a shipped file. The other tables take dictionaries from the references of a scene.
DICTIONARIES: Mapping[str, tuple[str, ...]] = {
    "table1": ("database", "public_database"),
    "table4": ("dictionary", "database", "public_database"),
    "tableS3": ("database",),
    "tableS4": ("database",),
    "figures": ("dictionary", "database", "public_database"),
}
NETWORKS: Mapping[str, tuple[str, ...]] = {
    "table1": ("raw_network", "affine_network"),
    "table4": ("raw_network", "affine_network", "ldp_network"),
    "figures": ("raw_network", "affine_network", "ldp_network"),
}
SCENES: Mapping[str, tuple[str, ...]] = {"tableS2": ("south-building", "fountain-p11")}  # all others: Aachen
SEPARATE = 60_000  # photographs of Places365 for each dictionary


def list_missing(name: str, given: Collection[str], takes_dataset: bool) -> Iterator[str]:
    """Yield a line on each part of the paper's data that a table or figure replaces by our own.

    Parameters
    ----------
    given : names of the inputs that the user passes: `images`, `dataset`, and fields of `Materials`
    """
    if takes_dataset and "dataset" not in given:
        for scene in SCENES.get(name, ("aachen-v1.1",)):
            yield f"{DATASETS[scene].title}: {_format_fetch(scene)}, then {DATASETS[scene].usage}"
    if not takes_dataset and "images" not in given:
        yield "the 10 photographs from Flickr: no download is published; give photographs with --images"
    if dictionaries := [option for option in DICTIONARIES.get(name, ()) if option not in given]:
        build = f"bench dictionary build with {SEPARATE:,} photographs for each of {_format_options(dictionaries)}"
        yield f"dictionaries of Places365: {_format_fetch('places365-train-256')}, then {build}"
    if networks := [option for option in NETWORKS.get(name, ()) if option not in given]:
        build = f"bench train --profile paper --images DIR for each of {_format_options(networks)}"
        yield f"networks trained on MegaDepth: {_format_fetch('megadepth')}, then {build}"


def _format_fetch(name: str) -> str:
    return f"bench dataset fetch {name} --to DIR"


def _format_options(fields: Collection[str]) -> str:
    return ", ".join(f"--{field.replace('_', '-')}" for field in fields)
