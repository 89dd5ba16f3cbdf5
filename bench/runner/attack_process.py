"""Execution of an attack in a process that never holds the secret.

The attack process is spawned, not forked. It receives the attack and its `View`: the release and the configurations, and on
request the knowledge in `needs`. The photograph and the true descriptors stay in the scoring process. The answer consists of
JSON and arrays. It contains no pickled objects, so the scoring process executes no code from it.

The two processes share no memory. This is no security sandbox. The attack process can read every file that its user can read,
and both processes import the plugin's module.
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

from bench import threat_model
from bench.api import Extractor, Selection, View
from bench.codebook.public import Public
from bench.core.child_process import end_with_parent
from bench.core.errors import SampleError
from bench.images.scene import Scene
from bench.localization.scene_index import SceneIndex
from bench.threat_model import Knowledge, OtherReleases, PublicAssets, ServerMap
from bench.types import Release

Method = Callable[[View, np.random.Generator], Any]


def execute_in_attack_process(method: Method, view: View, rng: np.random.Generator) -> Any:
    """Return the result of `method(view, rng)`, executed in a new process (an `Execute`).

    `rng` and the notes of the view change as the method changes them.

    Raises
    ------
    SampleError
        if the attack raises it, or the attack process ends early.
    RuntimeError
        if the attack raises another error; the message contains its traceback.
    """
    context = multiprocessing.get_context("spawn")  # a fork would copy the memory of this process
    ours, theirs = context.Pipe()
    process = context.Process(target=_execute, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    try:
        granted = sorted(kind.__name__ for kind in view.knowledge)
        ours.send((method, dataclasses.replace(view, knowledge={}, notes=[]), granted, rng))
        return _serve(ours, view, rng)
    except (EOFError, ConnectionError):
        process.join()
        raise SampleError(f"the attack process ended with status {process.exitcode}") from None
    finally:
        ours.close()
        process.join(1)
        process.kill()


def _serve(ours: Connection, view: View, rng: np.random.Generator) -> Any:
    """Answer the requests of the attack process, and return its result."""
    while True:
        message = json.loads(ours.recv_bytes())
        if message["kind"] == "request":
            ours.send(_pack(view, getattr(threat_model, message["class"]), message["count"]))
        elif message["kind"] == "done":
            arrays = load(ours.recv_bytes())
            rng.bit_generator.state = message["rng"]
            view.notes.extend(message["notes"])
            return Selection(**arrays) if message["selection"] else arrays["estimate"]
        elif message["kind"] == "sample error":
            raise SampleError(message["text"])
        else:
            raise RuntimeError(message["text"])


def _pack(view: View, kind: type[Knowledge], count: int) -> Any:
    """Return knowledge in a form that can be sent, without caches: they can hold the nearest words of the secret."""
    knowledge = view.know(kind)
    if isinstance(knowledge, OtherReleases):
        return list(knowledge.draw(count))
    if isinstance(knowledge, PublicAssets):
        return _scene_of(knowledge.assets)
    if isinstance(knowledge, ServerMap):
        return _scene_of(knowledge.server.public), knowledge.server.camera
    return knowledge


def _unpack(theirs: Connection, kind: type[Knowledge]) -> Knowledge:
    """Return knowledge as `View.know` returns it."""
    if kind is OtherReleases:
        return OtherReleases(draw=functools.partial(_other_releases, theirs))
    packed = _request(theirs, kind, 0)
    if kind is PublicAssets:
        return PublicAssets(assets=_public(packed))
    if kind is ServerMap:
        from bench.localization.server import Server  # it imports COLMAP

        scene, camera = packed
        return ServerMap(server=Server(public=_public(scene), camera=camera))
    assert isinstance(packed, kind)
    return packed


def _scene_of(public: Public) -> tuple[Scene, Extractor] | None:
    """Return the server's scene and extractor; None without a scene. The index has no queries, one of which is the secret."""
    index = public.scene_index
    return None if index is None else (index.scene, index.extractor)


def _public(served: tuple[Scene, Extractor] | None) -> Public:
    """Return the public assets, with the index of the server's scene."""
    return Public(scene_index=None if served is None else SceneIndex(*served))


def _other_releases(theirs: Connection, count: int) -> Iterator[Release]:
    return iter(_request(theirs, OtherReleases, count))


def _request(theirs: Connection, kind: type[Knowledge], count: int) -> Any:
    theirs.send_bytes(json.dumps({"kind": "request", "class": kind.__name__, "count": count}).encode())
    return theirs.recv()


def _execute(theirs: Connection) -> None:
    """Execute the method in the attack process, and send its result."""
    import traceback

    end_with_parent()
    method, view, granted, rng = theirs.recv()
    kinds = [getattr(threat_model, name) for name in granted]
    view = dataclasses.replace(view, knowledge={kind: functools.partial(_unpack, theirs, kind) for kind in kinds})
    try:
        result = method(view, rng)
        selection = isinstance(result, Selection)
        arrays = {"rows": result.rows, "descriptors": result.descriptors} if selection else {"estimate": result}
        blob = save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
        message = {"kind": "done", "selection": selection, "rng": rng.bit_generator.state, "notes": list(map(str, view.notes))}
        theirs.send_bytes(json.dumps(message).encode())
        theirs.send_bytes(blob)
    except SampleError as error:
        theirs.send_bytes(json.dumps({"kind": "sample error", "text": str(error)}).encode())
    except Exception:
        theirs.send_bytes(json.dumps({"kind": "error", "text": traceback.format_exc()}).encode())
