"""An attack that kills its process, once or always."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.api import ImageAttack, View
from bench.types import Descriptors, Floats, Subspaces, WordSets


@dataclass(frozen=True, kw_only=True)
class Fatal(ImageAttack):
    """Kills its process at the first call, or without a marker at every call. Otherwise returns a grey image."""

    accepts = (Descriptors, WordSets, Subspaces)

    marker: str = ""  # a file that exists after the first call; text, since its content is not part of the configuration

    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        marker = Path(self.marker) if self.marker else None
        if marker is None or not marker.exists():
            if marker is not None:
                marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return np.full((*view.release.size[::-1], 3), 0.5, np.float32)


PLUGIN = Fatal
