"""The gallery: a made-up building that is rendered here, so its poses are exact and in metres, and nothing need be fetched.

A courtyard and four rooms, hung with pictures (photographs that the libraries carry, and painted by chance), furnished, lit with
shadows; references are taken on walks by day, queries beside those walks by day and by night, with people before them who are in
no other image's map. Everything is a function of the fields of `Gallery`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

import bench.rendering
from bench.api import Dataset
from bench.core.errors import UserError
from bench.images.scene import Condition, Mask, Pixels, Reference, Scene, SceneImage
from bench.rendering import crowd, cutouts, walks
from bench.rendering.building import Building, build
from bench.rendering.cutouts import Person
from bench.rendering.raster import Eye, draw
from bench.rendering.rooms import ROOMS
from bench.rendering.sensor import Sensor, expose, metered
from bench.rendering.walks import Station
from bench.types import Bytes, Floats

FIELD_OF_VIEW = np.radians(63.0)  # of the references, from left to right
QUERY_ZOOMS = (0.92, 1.0, 1.15)  # focal lengths of the phones that queries are taken with, relative to the references'
CAST = 12  # people to choose from

Kind = Literal["reference", "query"]


@dataclass(frozen=True, kw_only=True)
class Gallery(Dataset):
    """A made-up building with pictures and people in it, rendered here; poses are exact and in metres."""

    seed: int = 0
    views: int = 300  # reference images
    queries: int = 300
    night: float = 1 / 3  # share of the queries
    width: int = 640  # pixels
    height: int = 480
    rooms: int = len(ROOMS)  # how many of them are visited, the courtyard first
    repeats: float = 0.1  # share of pictures that hang elsewhere as well
    bare: float = 0.15  # share of places on the walls left empty
    viewpoint: float = 1.0  # how far queries are from the walks: 1 is about 0.7 m and 20 degrees
    people: float = 1.5  # in an image, on average
    blur: float = 1.0  # of queries; 1 is about a pixel
    noise: float = 1.0  # of queries; 1 is a good sensor's
    detail: float = 1.0  # of textures and light; 1 is about a texel a pixel from 1.5 m away

    def __post_init__(self) -> None:
        if self.views < 1 or min(self.queries, self.seed) < 0 or not 1 <= self.rooms <= len(ROOMS):
            raise UserError(f"gallery: at least one view, neither queries nor seed negative, and 1 to {len(ROOMS)} rooms")
        if min(self.width, self.height) < 32 or not 0 < self.detail <= 4:
            raise UserError("gallery: images are at least 32 pixels wide and high, and detail is above 0 and at most 4")
        if not all(0 <= share <= 1 for share in (self.night, self.repeats, self.bare)):
            raise UserError("gallery: night, repeats and bare are shares from 0 to 1")
        if not all(0 <= amount < np.inf for amount in (self.viewpoint, self.people, self.blur, self.noise)):
            raise UserError("gallery: viewpoint, people, blur and noise are finite and not negative")

    def scene(self) -> Scene:
        model = _model(self)
        return Scene(
            name="gallery",
            references=tuple(_reference(model, index) for index in range(self.views)),
            queries=tuple(_query(model, index) for index in range(self.queries)),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One rendered image with all that is known of it."""

    pixels: Bytes  # (H, W, 3)
    foreground: Mask  # (H, W)
    depth: Floats  # (H, W) metres along the optical axis; infinite in the sky


@dataclass(frozen=True, kw_only=True)
class Rendered(Pixels):
    """An image of the gallery, rendered when it is read."""

    gallery: Gallery
    kind: Kind
    index: int

    def content_hash(self) -> str:
        return "sha256:" + hashlib.sha256(f"{_renderer()} {self}".encode()).hexdigest()

    def read(self) -> Bytes:
        return shot(self.gallery, self.kind, self.index).pixels

    def foreground(self) -> Mask:
        return shot(self.gallery, self.kind, self.index).foreground


@lru_cache(maxsize=16)  # read and foreground ask for the same
def shot(gallery: Gallery, kind: Kind, index: int) -> Shot:
    """Render one image."""
    model = _model(gallery)
    taken = model.taken[kind][index]
    night = taken.condition == "night"
    building, eye = model.building, _eye(taken)
    mine = [gallery.seed, 7, int(kind == "query"), index]
    present = crowd.gather(np.random.default_rng([*mine, 0]), _cast(gallery.seed)[kind], gallery.people, eye, building, night)
    drawing = draw(eye, building.night if night else building.day, present, lambda rays: building.sky_at(rays, night))
    sensor = _sensor(gallery, kind, night)
    pixels = expose(drawing.light, sensor, metered(drawing.light), np.random.default_rng([*mine, 1]))
    return Shot(pixels=pixels, foreground=drawing.foreground, depth=drawing.depth)


@cache
def _renderer() -> str:
    """Changes whenever the same fields may give other pixels."""
    files = [*Path(bench.rendering.__path__[0]).glob("*.py"), Path(__file__)]
    parts = [file.read_text(encoding="utf-8") for file in sorted(files)]
    parts += [version(library) for library in ("numpy", "opencv-python-headless", "scikit-image", "scikit-learn", "matplotlib")]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True, eq=False)
class _Taken:
    """When, where and with what an image was taken."""

    name: str
    station: Station
    camera: pycolmap.Camera
    condition: Condition


@dataclass(frozen=True, eq=False)
class _Model:
    """What all images of one gallery share."""

    gallery: Gallery

    @property
    def building(self) -> Building:
        g = self.gallery
        return _building(g.seed, g.repeats, g.bare, g.detail)

    @cached_property
    def taken(self) -> dict[Kind, list[_Taken]]:
        g = self.gallery
        rooms = ROOMS[: g.rooms]
        by_day = g.queries - round(g.night * g.queries)
        references = [
            _Taken(name=f"db/{room.name}-{lap}-{number:04d}.png", station=station, camera=_camera(g, 1.0), condition="day")
            for number, (room, lap, station) in enumerate(walks.references(rooms, g.views, self.building, g.seed))
        ]
        queries = []
        for number, (_, station) in enumerate(walks.queries(rooms, g.queries, self.building, g.seed, g.viewpoint)):
            condition: Condition = "day" if number < by_day else "night"
            phone = int(np.random.default_rng([g.seed, 9, number]).integers(len(QUERY_ZOOMS)))
            name = f"query/{condition}/phone{phone}/{condition}-{number:04d}.png"
            queries.append(_Taken(name=name, station=station, camera=_camera(g, QUERY_ZOOMS[phone]), condition=condition))
        return {"reference": references, "query": queries}


@lru_cache(maxsize=8)
def _model(gallery: Gallery) -> _Model:
    return _Model(gallery)


@lru_cache(maxsize=2)
def _cast(seed: int) -> dict[Kind, list[Person]]:
    rngs = (np.random.default_rng([seed, 8, number]) for number in range(2))
    return {"reference": cutouts.of_map(next(rngs), CAST), "query": cutouts.of_queries(next(rngs), CAST)}


@lru_cache(maxsize=2)  # its textures are large
def _building(seed: int, repeats: float, bare: float, detail: float) -> Building:
    return build(seed, repeats=repeats, bare=bare, detail=detail)


def _camera(gallery: Gallery, zoom: float) -> pycolmap.Camera:
    focal = zoom * gallery.width / 2 / np.tan(FIELD_OF_VIEW / 2)
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", round(float(focal), 3), gallery.width, gallery.height)


def _reference(model: _Model, index: int) -> Reference:
    taken = model.taken["reference"][index]
    return Reference(
        name=taken.name,
        camera=taken.camera,
        cam_from_world=_pose(taken),
        condition=taken.condition,
        pixels=Rendered(gallery=model.gallery, kind="reference", index=index),
    )


def _query(model: _Model, index: int) -> SceneImage:
    taken = model.taken["query"][index]
    return SceneImage(
        name=taken.name,
        camera=taken.camera,
        cam_from_world=_pose(taken),
        condition=taken.condition,
        pixels=Rendered(gallery=model.gallery, kind="query", index=index),
    )


def _pose(taken: _Taken) -> pycolmap.Rigid3d:
    rotation = taken.station.rotation
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ taken.station.centre)


def _eye(taken: _Taken) -> Eye:
    rotation = taken.station.rotation
    return Eye(
        calibration=taken.camera.calibration_matrix(),
        rotation=rotation,
        translation=-rotation @ taken.station.centre,
        size=(taken.camera.width, taken.camera.height),
    )


def _sensor(gallery: Gallery, kind: Kind, night: bool) -> Sensor:
    if kind == "reference":
        return Sensor(defocus=0.4, shake=0.0, noise=1.0, cast=0.02)
    blur = gallery.blur * (1.3 if night else 1.0)
    return Sensor(defocus=0.55 * blur, shake=1.2 * blur, noise=1.5 * gallery.noise, cast=0.04)


PLUGIN = Gallery
