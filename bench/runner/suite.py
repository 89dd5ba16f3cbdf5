"""Suites: what `bench sweep` runs, as plain Python objects.

SUITE = Suite(
    summary="Does rounding help?",
    parts=grid(defenses=[Undefended(), Rounding(levels=4)], attacks=[DIA(weights=Asset("W.safetensors"))], seeds=range(3)),
)

A suite is a module's attribute, here or elsewhere: `bench sweep smoke` means `SUITE` of the file suites/smoke.py, and
`bench sweep mine/suite.py:SUITE` or `bench sweep package.module:SUITE` one of your own.
"""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import pkgutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.api import Attack, Dataset, Defense, Extractor, Task
from bench.core.errors import UserError, unknown_name
from bench.extractors.sift import Sift
from bench.images.samples import Images
from bench.runner import plan
from bench.runner.plan import RunConfiguration
from bench.tasks.reconstruction import Reconstruction

PACKAGE = "suites"


@dataclass(frozen=True, kw_only=True, eq=False)
class Suite:
    """Experiments that belong together. Each part has one task, one set of images, one extractor and one seed."""

    summary: str
    parts: tuple[RunConfiguration, ...]

    def on(self, images: Images) -> Suite:
        """The same with other photographs, where it judges photographs."""
        parts = (part if part.dataset else dataclasses.replace(part, images=images) for part in self.parts)
        return dataclasses.replace(self, parts=tuple(parts))


def grid(
    *,
    defenses: Sequence[Defense],
    attacks: Sequence[Attack] = (),
    tasks: Sequence[Task] = (Reconstruction(),),
    images: Images = None,
    datasets: Sequence[Dataset | None] = (None,),
    extractors: Sequence[Extractor] = (Sift(),),
    seeds: Sequence[int] = (0,),
) -> tuple[RunConfiguration, ...]:
    """Every defense against every attack, judged by every task, for every dataset, extractor and seed.

    A task that judges the release itself takes no attack, and `attacks` are not for it.

    Raises
    ------
    UserError
        if there is no defense, or no attack for a task that needs one.
    """
    return tuple(
        RunConfiguration(
            pairs=plan.cross(task, defenses, attacks if task.judges_attacks else ()),
            images=images,
            task=task,
            extractor=extractor,
            dataset=dataset,
            seed=seed,
        )
        for task, dataset, extractor, seed in itertools.product(tasks, datasets, extractors, seeds)
    )


def names() -> list[str]:
    """The suites of this distribution."""
    package = importlib.import_module(PACKAGE)
    return sorted(info.name.replace("_", "-") for info in pkgutil.iter_modules(package.__path__))


def find(text: str) -> Suite:
    """The suite that is meant: by name, as `module:NAME`, or as `path/to/file.py:NAME`.

    Raises
    ------
    UserError
        if there is none, or it cannot be imported.
    """
    place, colon, attribute = text.rpartition(":")
    if not colon:
        if text not in names():
            raise unknown_name("suite", text, names())
        place, attribute = f"{PACKAGE}.{text.replace('-', '_')}", "SUITE"
    try:
        module = importlib.import_module(_module(place))
    except UserError:
        raise
    except Exception as error:  # whatever a stranger's module raises while it is imported
        raise UserError(f"suite {text!r}: {place} cannot be imported: {type(error).__name__}: {error}") from error
    found = getattr(module, attribute, None)
    if not isinstance(found, Suite):
        raise UserError(
            f"suite {text!r}: {place} has no Suite called {attribute!r} (bench/runner/suite.py shows how one is written)"
        )
    return found


def folder(text: str) -> Path:
    """Where its results lie, unless it is said where: `runs/sweep-` and its name, or those of its file or module and its own."""
    place, colon, attribute = text.rpartition(":")
    stem = Path(place).stem if place.endswith(".py") else place.rpartition(".")[2]
    return Path("runs") / f"sweep-{f'{stem}-{attribute}' if colon else text}"


def _module(place: str) -> str:
    """The module's name. A file's folder is searched first from now on, in worker processes too."""
    if not place.endswith(".py"):
        return place
    file = Path(place).resolve()
    if not file.is_file():
        raise UserError(f"{place}: no such file")
    sys.path.insert(0, str(file.parent))
    return file.stem
