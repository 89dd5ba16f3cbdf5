"""Plugins that print the number of their process, and sleep until it is ended."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.api import Extractor, ImageAttack, View
from bench.types import Bytes, Descriptors, Features, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Sleeper(ImageAttack):
    """Never ends."""

    accepts = (Descriptors, WordSets, Subspaces)

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        return sleep()


@dataclass(frozen=True, kw_only=True)
class SleepingExtractor(Extractor):
    """Never ends."""

    def extract(self, image: Bytes, source: Path | None = None) -> Features:
        return sleep()


def sleep(*arguments: Any) -> Any:
    os.write(1, f"{os.getpid()}\n".encode())
    time.sleep(1000)


PLUGIN = Sleeper
