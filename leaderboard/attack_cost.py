"""The cost of an attack: training samples of its networks, and core seconds a photograph."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterable, Mapping
from statistics import median
from typing import Any

from bench.codebook.public import ASSETS
from bench.context import weights as context
from bench.formats import tensor_file
from bench.inversion import weights as inversion
from bench.positions import neighbour_model
from bench.runner.records import Record

NETWORKS = (inversion.KIND, context.KIND, neighbour_model.KIND)  # kinds of files


def count_training_samples(attack: Mapping[str, Any]) -> int | None:
    """Return the training samples of all networks of a recorded attack, over all their training stages; 0 without a network.

    The network that inverts its result counts, and so does the context model that a network reads. Return None if a file of
    the attack is not shipped, or is recorded without its digest.
    """
    shipped, digests = _read_shipped(), set(re.findall(r'"(sha256:[0-9a-f]{64}|shipped[^"]*)"', json.dumps(attack)))
    digests |= {shipped[one][1].get("context", one) for one in digests & shipped.keys()}  # read by the network `one`
    if not digests <= shipped.keys():
        return None
    networks = [meta for kind, meta in map(shipped.__getitem__, digests) if kind in NETWORKS]
    stages = [stage for meta in networks for stage in ([meta] if "steps" in meta else inversion.list_training_stages(meta))]
    return sum(stage["steps"] * stage["batch"] if "steps" in stage else stage["crops"] for stage in stages)


@functools.cache
def _read_shipped() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return kind and metadata of each shipped file by its digest."""
    headers = map(tensor_file.read_header, ASSETS.glob("*.safetensors"))
    return {digest: (kind, json.loads(meta)) for kind, meta, digest in headers}


def measure_core_seconds(records: Iterable[Record]) -> float | None:
    """Return the median over records of the seconds of a photograph times the threads; None if no record of a CPU states both."""
    runs = [(one.get("seconds"), one["environment"].get("threads"), one["environment"].get("device")) for one in records]
    times = [seconds * threads for seconds, threads, device in runs if device == "cpu" and seconds and type(threads) is int]
    return median(times) if times else None
