"""The gallery: a synthetic building, rendered on demand. Its poses are exact and in metres, and no download is needed.

A courtyard and four rooms with pictures (the libraries' photographs, and random drawings), furniture, and light with shadows.
References are taken on walks by day, queries beside those walks by day and by night. People in the map and in queries differ.
Everything is a function of the fields of `Gallery`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

import bench.rendering
from bench.api import Dataset
from bench.core.errors import UserError
from bench.images.scene import Condition, Mask, Pixels, Reference, Scene, SceneImage
from bench.rendering import crowd, cutouts, walks
from bench.rendering.building import Building, build
from bench.rendering.cutouts import Person
from bench.rendering.raster import PinholeCamera, draw
from bench.rendering.rooms import ROOMS
from bench.rendering.sensor import Sensor, compute_gain, expose
from bench.rendering.walks import Station
from bench.types import Bytes, Floats

if TYPE_CHECKING:
    import pycolmap

FIELD_OF_VIEW = np.radians(63.0)  # of the references, from left to right
QUERY_ZOOMS = (0.92, 1.0, 1.15)  # focal lengths of the queries' phones, relative to the references'
PEOPLE = 12  # to choose from

Kind = Literal["reference", "query"]


@dataclass(frozen=True, kw_only=True)
class Gallery(Dataset):
    """A synthetic building with pictures and people, rendered on demand; poses are exact and in metres."""

    seed: int = 0
    views: int = 300  # reference images
    queries: int = 300
    night: float = 1 / 3  # fraction of the queries
    width: int = 640  # pixels
    height: int = 480
    rooms: int = len(ROOMS)  # rooms visited, the courtyard first
    repeats: float = 0.1  # fraction of pictures that repeat another one
    bare: float = 0.15  # fraction of wall positions left empty
    viewpoint: float = 1.0  # distance of queries from the walks: 1 is about 0.7 m and 20 degrees
    people: float = 1.5  # in an image, on average
    blur: float = 1.0  # of queries; 1 is about a pixel
    noise: float = 1.0  # of queries; 1 is a good sensor's
    detail: float = 1.0  # of textures and light; 1 is about a texel a pixel from 1.5 m away

    def __post_init__(self) -> None:
        if self.views < 1 or min(self.queries, self.seed) < 0 or not 1 <= self.rooms <= len(ROOMS):
            raise UserError(f"gallery: at least one view, neither queries nor seed negative, and 1 to {len(ROOMS)} rooms")
        if min(self.width, self.height) < 32 or not 0 < self.detail <= 4:
            raise UserError("gallery: images are at least 32 pixels wide and high, and detail is above 0 and at most 4")
        if not all(0 <= fraction <= 1 for fraction in (self.night, self.repeats, self.bare)):
            raise UserError("gallery: night, repeats and bare are fractions from 0 to 1")
        if not all(0 <= amount < np.inf for amount in (self.viewpoint, self.people, self.blur, self.noise)):
            raise UserError("gallery: viewpoint, people, blur and noise are finite and not negative")

    def scene(self) -> Scene:
        model = _load_model(self)
        return Scene(
            name="gallery",
            references=tuple(_create_reference(model, index) for index in range(self.views)),
            queries=tuple(_create_query(model, index) for index in range(self.queries)),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One rendered image with its foreground and depth."""

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
        return "sha256:" + hashlib.sha256(f"{_hash_renderer()} {self}".encode()).hexdigest()

    def read(self) -> Bytes:
        return render(self.gallery, self.kind, self.index).pixels

    def foreground(self) -> Mask:
        return render(self.gallery, self.kind, self.index).foreground


@lru_cache(maxsize=16)  # `read` and `foreground` need the same image
def render(gallery: Gallery, kind: Kind, index: int) -> Shot:
    """Render one image."""
    model = _load_model(gallery)
    view = model.views[kind][index]
    night = view.condition == "night"
    building, camera = model.building, _create_pinhole_camera(view)
    key = [gallery.seed, 7, int(kind == "query"), index]
    people = crowd.gather_people(
        np.random.default_rng([*key, 0]), _create_people(gallery.seed)[kind], gallery.people, camera, building, night
    )
    drawing = draw(camera, building.night if night else building.day, people, lambda rays: building.compute_sky(rays, night))
    sensor = _choose_sensor(gallery, kind, night)
    pixels = expose(drawing.light, sensor, compute_gain(drawing.light), np.random.default_rng([*key, 1]))
    return Shot(pixels=pixels, foreground=drawing.foreground, depth=drawing.depth)


@cache
def _hash_renderer() -> str:
    """Hash everything except the fields that determines the pixels: source and library versions."""
    files = [*Path(bench.rendering.__path__[0]).glob("*.py"), Path(__file__)]
    parts = [file.read_text(encoding="utf-8") for file in sorted(files)]
    parts += [version(library) for library in ("numpy", "opencv-python-headless", "scikit-image", "scikit-learn", "matplotlib")]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """The pose, camera and condition of an image."""

    name: str
    station: Station
    camera: pycolmap.Camera
    condition: Condition


@dataclass(frozen=True, eq=False)
class _Model:
    """The building and the views of one gallery."""

    gallery: Gallery

    @property
    def building(self) -> Building:
        g = self.gallery
        return _load_building(g.seed, g.repeats, g.bare, g.detail)

    @cached_property
    def views(self) -> dict[Kind, list[_View]]:
        g = self.gallery
        rooms = ROOMS[: g.rooms]
        by_day = g.queries - round(g.night * g.queries)
        references = [
            _View(name=f"db/{room.name}-{lap}-{number:04d}.png", station=station, camera=_create_camera(g, 1.0), condition="day")
            for number, (room, lap, station) in enumerate(walks.generate_references(rooms, g.views, self.building, g.seed))
        ]
        queries = []
        for number, (_, station) in enumerate(walks.generate_queries(rooms, g.queries, self.building, g.seed, g.viewpoint)):
            condition: Condition = "day" if number < by_day else "night"
            phone = int(np.random.default_rng([g.seed, 9, number]).integers(len(QUERY_ZOOMS)))
            name = f"query/{condition}/phone{phone}/{condition}-{number:04d}.png"
            queries.append(_View(name=name, station=station, camera=_create_camera(g, QUERY_ZOOMS[phone]), condition=condition))
        return {"reference": references, "query": queries}


@lru_cache(maxsize=8)
def _load_model(gallery: Gallery) -> _Model:
    return _Model(gallery)


@lru_cache(maxsize=2)
def _create_people(seed: int) -> dict[Kind, list[Person]]:
    rngs = (np.random.default_rng([seed, 8, number]) for number in range(2))
    return {"reference": cutouts.create_map_people(next(rngs), PEOPLE), "query": cutouts.create_query_people(next(rngs), PEOPLE)}


@lru_cache(maxsize=2)  # its textures are large
def _load_building(seed: int, repeats: float, bare: float, detail: float) -> Building:
    return build(seed, repeats=repeats, bare=bare, detail=detail)


def _create_camera(gallery: Gallery, zoom: float) -> pycolmap.Camera:
    import pycolmap

    focal = zoom * gallery.width / 2 / np.tan(FIELD_OF_VIEW / 2)
    return pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", round(float(focal), 3), gallery.width, gallery.height)


def _create_reference(model: _Model, index: int) -> Reference:
    view = model.views["reference"][index]
    return Reference(
        name=view.name,
        camera=view.camera,
        cam_from_world=_compute_pose(view),
        condition=view.condition,
        pixels=Rendered(gallery=model.gallery, kind="reference", index=index),
    )


def _create_query(model: _Model, index: int) -> SceneImage:
    view = model.views["query"][index]
    return SceneImage(
        name=view.name,
        camera=view.camera,
        cam_from_world=_compute_pose(view),
        condition=view.condition,
        pixels=Rendered(gallery=model.gallery, kind="query", index=index),
    )


def _compute_pose(view: _View) -> pycolmap.Rigid3d:
    import pycolmap

    rotation = view.station.rotation
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ view.station.centre)


def _create_pinhole_camera(view: _View) -> PinholeCamera:
    rotation = view.station.rotation
    return PinholeCamera(
        calibration=view.camera.calibration_matrix(),
        rotation=rotation,
        translation=-rotation @ view.station.centre,
        size=(view.camera.width, view.camera.height),
    )


def _choose_sensor(gallery: Gallery, kind: Kind, night: bool) -> Sensor:
    if kind == "reference":
        return Sensor(defocus=0.4, shake=0.0, noise=1.0, cast=0.02)
    blur = gallery.blur * (1.3 if night else 1.0)
    return Sensor(defocus=0.55 * blur, shake=1.2 * blur, noise=1.5 * gallery.noise, cast=0.04)


PLUGIN = Gallery
