"""Suites: the experiments of `bench sweep`, as Python objects.

SUITE = Suite(
    summary="Does rounding help?",
    parts=grid(defenses=[Undefended(), Rounding(levels=4)], attacks=[DIA(weights=Asset("W.safetensors"))], seeds=range(3)),
)

A suite is an attribute of a module. `bench sweep smoke` runs `SUITE` of the file suites/smoke.py. To run your own suite, write
`bench sweep mine/suite.py:SUITE` or `bench sweep package.module:SUITE`.
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

from bench.api import Attack, Dataset, Defense, Extractor
from bench.core.errors import UserError, unknown_name
from bench.extractors.sift import Sift
from bench.images.samples import Images
from bench.runner.plan import RunConfiguration, cross, list_extra_metrics
from bench.task_api import Task
from bench.tasks.reconstruction import Reconstruction

PACKAGE = "suites"


@dataclass(frozen=True, kw_only=True, eq=False)
class Suite:
    """Experiments that belong together. Each part has one task, one set of images, one extractor and one seed."""

    summary: str
    parts: tuple[RunConfiguration, ...]

    def with_images(self, images: Images) -> Suite:
        """Return the suite with other photographs, in the parts without a dataset."""
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
    """Return every defense × attack × task, for every dataset, extractor and seed.

    A task that evaluates the release itself ignores `attacks`. The metrics of the installed extras are computed as well.

    Raises
    ------
    UserError
        if there is no defense, or no attack for a task that needs one.
    """
    metrics = list_extra_metrics()
    return tuple(
        RunConfiguration(
            pairs=cross(task, defenses, attacks if task.judges_attacks else ()),
            images=images,
            task=task,
            extractor=extractor,
            dataset=dataset,
            seed=seed,
            metrics=metrics,
        )
        for task, dataset, extractor, seed in itertools.product(tasks, datasets, extractors, seeds)
    )


def list_suites() -> list[str]:
    """Return the names of the suites of this distribution."""
    package = importlib.import_module(PACKAGE)
    return sorted(info.name.replace("_", "-") for info in pkgutil.iter_modules(package.__path__))


def find(text: str) -> Suite:
    """Return a suite by its name, by `module:NAME`, or by `path/to/file.py:NAME`.

    Raises
    ------
    UserError
        if there is no such suite, or its module cannot be imported.
    """
    module_path, colon, attribute = text.rpartition(":")
    if not colon:
        if text not in list_suites():
            raise unknown_name("suite", text, list_suites())
        module_path, attribute = f"{PACKAGE}.{text.replace('-', '_')}", "SUITE"
    try:
        module = importlib.import_module(_import_path(module_path))
    except UserError:
        raise
    except Exception as error:  # a user's module can raise any error
        raise UserError(f"suite {text!r}: {module_path} cannot be imported: {type(error).__name__}: {error}") from error
    suite = getattr(module, attribute, None)
    if not isinstance(suite, Suite):
        raise UserError(
            f"suite {text!r}: {module_path} has no Suite called {attribute!r} (bench/runner/suite.py shows an example)"
        )
    return suite


def choose_folder(text: str) -> Path:
    """Return the default folder of results: `runs/sweep-` and the suite's name, or the names of its module and attribute."""
    module_path, colon, attribute = text.rpartition(":")
    stem = Path(module_path).stem if module_path.endswith(".py") else module_path.rpartition(".")[2]
    return Path("runs") / f"sweep-{f'{stem}-{attribute}' if colon else text}"


def _import_path(module_path: str) -> str:
    """Return the import name of a module. The folder of a file is put first on the import path, also for worker processes."""
    if not module_path.endswith(".py"):
        return module_path
    file = Path(module_path).resolve()
    if not file.is_file():
        raise UserError(f"{module_path}: no such file")
    sys.path.insert(0, str(file.parent))
    return file.stem
