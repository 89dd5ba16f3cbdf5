"""Ends the process that it runs in: once, or always."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import ImageAttack, View
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Fatal(ImageAttack):
    """Grey, where it does not kill its process: the first time, or every time if there is no marker."""

    accepts = (Descriptors, WordSets, Subspaces)

    marker: str = ""  # a file that says that it has been done; as text, since its content is no configuration

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        marker = Path(self.marker) if self.marker else None
        if marker is None or not marker.exists():
            if marker is not None:
                marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.full((*view.release.size[::-1], 3), 0.5, np.float32)


PLUGIN = Fatal
