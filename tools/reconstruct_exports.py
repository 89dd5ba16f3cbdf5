"""Reconstruction by COLMAP from exports: twelve views of the gallery's courtyard; raw, released and recovered descriptors.

COLMAP matches all pairs, and its incremental mapper is given no intrinsics and no poses. The best model is the one with the most
images. The page is docs/results/exports.md.

    python tools/reconstruct_exports.py --work WORK
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from result_page import write_page

from bench import cli
from bench.codebook.public import Public
from bench.core.colmap_log import silence_colmap
from bench.core.errors import UserError
from bench.core.table import markdown_row
from bench.datasets.walk import Walk
from bench.extractors.sift import Sift
from bench.formats import scene_export
from bench.images.scene import Scene
from bench.registry import discovery, spec

VIEWS = 12
# Defense and attack; without an attack, all released descriptors are exported.
EXPORTS: tuple[tuple[str, str | None], ...] = (
    ("none", None),
    ("ldp:epsilon=16", None),
    ("ldp:epsilon=16", "context"),
    ("ldp", None),
    ("ldp", "context"),
    ("affine", "nearest"),
    ("affine", "lattice"),
)
TEXT = f"""# Exports in COLMAP

Each row is one COLMAP database of {VIEWS} rendered views (`walk:views={VIEWS}`, 640 by 480 pixels). It was written by
`bench export --full-images --layout colmap --camera-mode single`. COLMAP matched all pairs and built a model. It received neither
intrinsics nor poses.

In rows without an attack, the database holds the released descriptors: each word of a set is a keypoint of its own. In the
others it holds the descriptors that the attack recovers. `ldp` has ε = 10, and `affine` hybrid lifting of dimension 4. Keypoints
are those of all views. The attack `database` has no row: it recovers descriptors with negative components, which COLMAP's
8-bit databases cannot hold.

"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, metavar="DIR", help="a folder for views, databases and models")
    args = parser.parse_args()
    if not (args.work / "walk").exists():
        write_views(Walk(views=VIEWS), args.work)
    rows: list[tuple[str, ...]] = [
        ("defense", "attack", "keypoints", "images in the model", "points", "reprojection error in pixels")
    ]
    rows.append(("---",) * len(rows[0]))
    for defense, attack in EXPORTS:
        row = (f"`{defense}`", f"`{attack}`" if attack else "none", *reconstruct(args.work, defense, attack))
        print(markdown_row(row), flush=True)
        rows.append(row)
    used = [entry for defense, attack in EXPORTS for entry in describe(defense, attack)]
    write_page("exports.md", TEXT + "\n".join(map(markdown_row, rows)), used)


def write_views(walk: Walk, work: Path) -> None:
    """Render the views of a walk into the folder `walk` of `work`."""
    scene = walk.scene()
    scene_export.write(Scene(name=scene.name, references=(), queries=scene.queries), "colmap", work / "walk")


def describe(defense: str, attack: str | None) -> Iterator[dict[str, Any]]:
    """Yield the configurations of a row, with the digests of their files."""
    public, plugin = Public(), spec.read(defense, discovery.DEFENSE)
    yield spec.to_json_with_digests(plugin, public)
    if attack is not None:
        attacker = spec.read(attack, discovery.ATTACK)
        yield spec.to_json_with_digests(attacker, public, attacker.assets(plugin, Sift(), public))


def reconstruct(work: Path, defense: str, attack: str | None) -> tuple[str, str, str, str]:
    """Export one row, unless it is in `work` already, and reconstruct it.

    Returns
    -------
    numbers of keypoints, of images in the best model, and of its points, and its mean reprojection error; n/a without a model
    """
    import pycolmap

    name = "-".join((defense, attack or "released")).replace(":", "-").replace("=", "-")
    images, database = work / "walk" / "images", work / f"{name}.db"
    if not database.exists():
        command = ["export", "--images", str(images), "--full-images", "--layout", "colmap", "--camera-mode", "single"]
        recovered = [] if attack is None else ["--attack", attack]
        if cli.main([*command, "--defense", defense, *recovered, "--out", str(database)]) != 0:
            raise UserError(f"{defense} {attack}: the export failed")
    with silence_colmap():
        pycolmap.match_exhaustive(database)
        (work / name).mkdir(exist_ok=True)
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
        models = pycolmap.incremental_mapping(database, images, work / name, options).values()
    with pycolmap.Database.open(database) as opened:
        keypoints = opened.num_keypoints()
    best = max(models, key=lambda model: model.num_reg_images(), default=None)
    if best is None:
        return str(keypoints), f"0 of {VIEWS}", "no model", "n/a"
    error = f"{best.compute_mean_reprojection_error():.2f}"
    return str(keypoints), f"{best.num_reg_images()} of {VIEWS}", str(best.num_points3D()), error


if __name__ == "__main__":
    main()
