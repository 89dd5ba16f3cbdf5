"""Carries out an attack in a process that never holds the secret.

The process is started afresh, and gets the attack, what `bench run` would show it, and no more: the release, configurations, and
knowledge that it declared to need, when it asks for it. The photograph and the true descriptors stay with whoever scores. What
comes back is JSON and arrays, never pickled objects, so that nothing of the attack's runs where the secret is.

It is a wall in memory. It is none on disk, where the process may read what its user may, and none for the plugin's module, which
both sides import.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import multiprocessing
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from bench.api import Extractor, Selection, View
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.core.errors import SampleError
from bench.images.scene import Scene
from bench.localization.scene_index import Place
from bench.types import Knowledge, Release

Method = Callable[[View, np.random.Generator], Any]


def execute_in_attack_process(method: Method, view: View, rng: np.random.Generator) -> Any:
    """What `method(view, rng)` returns, `rng` and the view's notes being left as it leaves them. A `CarryOut`.

    Raises
    ------
    UnitError
        if the attack raises that, or its process ends.
    RuntimeError
        if the attack raises something else; the message has its traceback.
    """
    context = multiprocessing.get_context("spawn")  # a fork would have all of this process's memory
    ours, theirs = context.Pipe()
    process = context.Process(target=_carry_out, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    try:
        ours.send((method, dataclasses.replace(view, knowledge={}, notes=[]), sorted(view.knowledge, key=str), rng))
        return _answered(ours, view, rng)
    except (EOFError, ConnectionError):
        process.join()
        raise SampleError(f"the process of the attack ended with status {process.exitcode}") from None
    finally:
        ours.close()
        process.join(1)
        process.kill()


def _answered(ours: Connection, view: View, rng: np.random.Generator) -> Any:
    """Tell the process what it asks for, until it is done."""
    while True:
        told = json.loads(ours.recv_bytes())
        if told["kind"] == "asks":
            ours.send(_known(view, Knowledge[told["what"]], told["count"]))
        elif told["kind"] == "done":
            arrays = load(ours.recv_bytes())
            rng.bit_generator.state = told["rng"]
            view.notes.extend(told["notes"])
            return Selection(**arrays) if told["selection"] else arrays["found"]
        elif told["kind"] == "unit error":
            raise SampleError(told["text"])
        else:
            raise RuntimeError(told["text"])


def _known(view: View, what: Knowledge, count: int) -> Any:
    """What can be sent of the knowledge `what`: no cache, for it may have seen where the secret quantises to."""
    value = view.know(what)
    if what is Knowledge.OTHER_RELEASES:
        return list(value(count))
    if what is Knowledge.TRAINING_IMAGES:
        return _served(value)
    if what is Knowledge.MAP:
        return _served(value.public), value.camera
    return dataclasses.replace(value) if isinstance(value, Dictionary) else value


def _served(public: Public) -> tuple[Scene, Extractor] | None:
    """The place that there is; it has no queries, one of which is the secret."""
    place = public.place
    return None if place is None else (place.scene, place.extractor)


def _carry_out(theirs: Connection) -> None:
    """What the other process does."""
    import traceback

    method, view, granted, rng = theirs.recv()
    view = dataclasses.replace(view, knowledge={what: functools.partial(_ask, theirs, what) for what in granted})
    try:
        found = method(view, rng)
        selection = isinstance(found, Selection)
        arrays = {"rows": found.rows, "descriptors": found.descriptors} if selection else {"found": found}
        blob = save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
        told = {"kind": "done", "selection": selection, "rng": rng.bit_generator.state, "notes": list(map(str, view.notes))}
        theirs.send_bytes(json.dumps(told).encode())
        theirs.send_bytes(blob)
    except SampleError as error:
        theirs.send_bytes(json.dumps({"kind": "unit error", "text": str(error)}).encode())
    except Exception:
        theirs.send_bytes(json.dumps({"kind": "error", "text": traceback.format_exc()}).encode())


def _ask(theirs: Connection, what: Knowledge) -> Any:
    """Knowledge as a `View` gives it."""
    if what is Knowledge.OTHER_RELEASES:
        return functools.partial(_others, theirs)
    told = _asked(theirs, what, 0)
    if what is Knowledge.TRAINING_IMAGES:
        return _public(told)
    if what is Knowledge.MAP:
        from bench.localization.server import Server  # it brings COLMAP with it

        return Server(public=_public(told[0]), camera=told[1])
    return told


def _public(served: tuple[Scene, Extractor] | None) -> Public:
    """What everyone can read."""
    return Public(place=None if served is None else Place(*served))


def _others(theirs: Connection, count: int) -> Iterator[Release]:
    return iter(_asked(theirs, Knowledge.OTHER_RELEASES, count))


def _asked(theirs: Connection, what: Knowledge, count: int) -> Any:
    theirs.send_bytes(json.dumps({"kind": "asks", "what": what.name, "count": count}).encode())
    return theirs.recv()
