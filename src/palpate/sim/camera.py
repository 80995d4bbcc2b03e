"""The photo: a view of 30 to 45 mm of the object around the contact, with what is irrelevant to
touch.

An object is lit once a video (sun, ambient light, occlusion in its pits, gloss, stains) on its
tile; a frame looks that tile up in perspective, adds the object's edge, a cast shadow, the hand
with the sensor, blur and noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from palpate.sim.arrays import Array, blend, f32, grid, hsv, over, sample_periodic, smoothstep
from palpate.sim.motion import State
from palpate.sim.objects import WorldObject
from palpate.sim.options import WorldOptions
from palpate.sim.tile import TILE_MM


@dataclass(frozen=True)
class Stain:
    """A spot on the object that shows but is not felt: place and radius in mm, aspect, angle,
    color, opacity.
    """

    place: tuple[float, float]
    radius: float
    aspect: float
    angle: float
    color: Array
    opacity: float


@dataclass(frozen=True)
class Camera:
    """Light and camera of one video; angles in radians, lengths of the view in half image widths.

    Attributes:
        view: width of the view in mm; turn, tilt: pose.
        sun_to: unit vector towards the sun; sun, ambient: strengths; light: RGB of the light;
            exposure: error of the auto-exposure.
        blur: deviation in pixels at 128 px; noise: deviation.
        hand: direction it enters from, or None; skin: its color.
        shadow: direction, offset and factor of a cast shadow, or None.
        edge: direction and distance of the object's edge, or None; beyond: color behind it.
    """

    view: float
    turn: float
    tilt: tuple[float, float]
    sun_to: tuple[float, float, float]
    sun: float
    ambient: float
    light: Array
    exposure: float
    blur: float
    noise: float
    hand: float | None
    skin: Array
    shadow: tuple[float, float, float] | None
    edge: tuple[float, float] | None
    beyond: Array


@dataclass(frozen=True)
class Scene:
    """An object as this video's light shows it: ``tile`` of shape (n, n, 3), and the exposure that
    was used.
    """

    tile: Array
    px: float
    exposure: float


def make_camera(options: WorldOptions, video: int) -> Camera:
    """Draws light and camera; ``options.hard`` scales everything that is irrelevant to touch."""
    rng = options.rng("camera", video)
    scale = 2.0 * options.hard
    happens = lambda share: bool(rng.random() < min(0.95, share * scale))  # noqa: E731
    elevation, azimuth = (
        math.radians(rng.uniform(*options.elevation_deg)),
        rng.uniform(0.0, 2.0 * math.pi),
    )
    warm = rng.uniform(-1.0, 1.0) * scale
    near, far = (math.log(end) for end in options.view_mm)
    view = math.exp(
        (near + far) / 2.0 + rng.uniform(-0.5, 0.5) * (far - near) * min(1.0, 0.4 + 0.6 * scale)
    )
    lean = 0.2 * min(1.4, scale)
    hand, from_side = happens(options.hand), rng.uniform(0.0, 2.0 * math.pi)
    shadow, shadow_at = (
        happens(options.shadow),
        (rng.uniform(0.0, math.pi), rng.uniform(-0.6, 0.6), rng.uniform(0.35, 0.75)),
    )
    edge, edge_at = (
        happens(options.edge),
        (rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.25, 0.75)),
    )
    bare = rng.random() < 0.6
    skin = hsv(rng.uniform(0.03, 0.08), rng.uniform(0.25, 0.55), rng.uniform(0.25, 0.9))
    glove = hsv(rng.random(), 0.2, rng.uniform(0.08, 0.5))
    return Camera(
        view=view,
        turn=rng.uniform(0.0, 2.0 * math.pi),
        tilt=(
            max(-0.5, min(0.5, rng.normal(0.0, lean + 1e-9))),
            max(-0.5, min(0.5, rng.normal(0.0, lean + 1e-9))),
        ),
        sun_to=(
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        ),
        sun=rng.uniform(0.25, 1.0),
        ambient=rng.uniform(0.35, 0.8),
        light=f32(
            np.array([1.0 + 0.13 * warm, 1.0, 1.0 - 0.13 * warm])
            * np.exp(rng.normal(0.0, 0.03 * scale + 1e-9, 3))
        ),
        exposure=math.exp(rng.normal(0.0, 0.2 * scale + 1e-9)),
        blur=options.blur_px[int(rng.integers(len(options.blur_px)))],
        noise=rng.uniform(0.004, 0.01 + 0.018 * options.hard),
        hand=from_side if hand else None,
        skin=skin if bare else glove,
        shadow=shadow_at if shadow else None,
        edge=edge_at if edge else None,
        beyond=hsv(rng.random(), rng.uniform(0.05, 0.6), rng.uniform(0.15, 0.85)),
    )


def _stains(options: WorldOptions, video: int, number: int) -> list[Stain]:
    rng = options.rng("stains", video, number)
    count = round((0, 0, 1, 2, 5)[int(rng.integers(5))] * 2.0 * options.hard * options.stains)
    return [
        Stain(
            place=(rng.uniform(0.0, TILE_MM), rng.uniform(0.0, TILE_MM)),
            radius=rng.uniform(1.0, 6.0),
            aspect=rng.uniform(0.4, 1.6),
            angle=rng.uniform(0.0, math.pi),
            color=hsv(rng.random(), rng.uniform(0.2, 1.0), rng.uniform(0.1, 1.0)),
            opacity=rng.uniform(0.4, 1.0),
        )
        for _ in range(count)
    ]


def light_object(
    options: WorldOptions, camera: Camera, body: WorldObject, video: int, number: int
) -> Scene:
    """Lights the tile of ``body`` (object ``number`` of the video) and filters it for the camera's
    pixel size.
    """
    height, px, n = body.surface.height, body.px, options.tile
    softened = ndimage.gaussian_filter(height, 0.6, mode="wrap")
    slope_y = (np.roll(softened, -1, 0) - np.roll(softened, 1, 0)) * (0.5 / px)
    slope_x = (np.roll(softened, -1, 1) - np.roll(softened, 1, 1)) * (0.5 / px)
    upright = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    lx, ly, lz = camera.sun_to
    direct = np.maximum((lz - slope_x * lx - slope_y * ly) * upright, 0.0)
    pit = height - ndimage.gaussian_filter(height, 1.2 / px, mode="wrap")
    open_sky = np.clip(1.0 + 0.55 * pit * (1.0 / (0.35 + float(height.std()))), 0.35, 1.25)
    albedo, half = body.surface.albedo, TILE_MM / 2.0
    at = f32(np.arange(n) * px)
    for stain in _stains(options, video, number):
        dy = (at[:, None] - stain.place[0] + half) % TILE_MM - half
        dx = (at[None] - stain.place[1] + half) % TILE_MM - half
        c, s = math.cos(stain.angle), math.sin(stain.angle)
        distance = np.hypot((c * dx + s * dy) * (1.0 / stain.aspect), c * dy - s * dx)
        albedo = blend(
            albedo,
            stain.color,
            smoothstep(distance, stain.radius, stain.radius * 0.9) * stain.opacity,
        )
    norm = math.sqrt(lx * lx + ly * ly + (lz + 1.0) ** 2)
    mirror = (
        np.maximum(((lz + 1.0) - slope_x * lx - slope_y * ly) * upright * (1.0 / norm), 0.0) ** 60
    )
    rgb = albedo * (camera.ambient * open_sky + camera.sun * direct)[..., None] * camera.light
    rgb += (mirror * (body.surface.gloss * 0.55 * camera.sun))[..., None]
    exposure = (
        0.40 * camera.exposure / (0.12 + float(rgb.mean()))
    ) ** 0.75  # imperfect, so that dark things stay darker
    blur = max(0.3, 0.42 * camera.view / options.size / px)
    lit = np.ascontiguousarray(np.moveaxis(rgb * exposure, 2, 0))
    return Scene(
        ndimage.gaussian_filter(lit, (0.0, blur, blur), mode="wrap", truncate=3.0), px, exposure
    )


def photo(
    options: WorldOptions, camera: Camera, scene: Scene, state: State, at: tuple[int, int]
) -> Array:
    """The photo at (video, frame), shape (n, n, 3), about [0, 1]; depends on no other frame."""
    video, frame = at
    rng = options.rng("photo", video, frame)
    size = options.size
    y, x = grid(size)
    sway = [
        0.012 * options.sway * math.sin(w * frame + video * p)
        for w, p in ((0.31, 1.0), (0.23, 2.0), (0.17, 3.0), (0.11, 5.0))
    ]
    depth = 1.0 + x * (camera.tilt[0] + sway[0]) + y * (camera.tilt[1] + sway[1])
    wy, wx = y / depth, x / depth
    reach = camera.view / 2.0 * (1.0 + sway[3]) / scene.px
    c, s = math.cos(camera.turn + sway[2]) * reach, math.sin(camera.turn + sway[2]) * reach
    shift_x, shift_y = rng.normal(0.0, 0.004) * reach, rng.normal(0.0, 0.004) * reach
    image = sample_periodic(
        scene.tile,
        s * wx + c * wy + (state.place[1] / scene.px + shift_y),
        c * wx - s * wy + (state.place[0] / scene.px + shift_x),
    )
    if camera.edge is not None:
        angle, distance = camera.edge
        past = smoothstep(math.cos(angle) * wx + math.sin(angle) * wy, distance, distance + 0.03)
        image = over(
            image,
            camera.beyond[:, None, None]
            * (0.8 + 0.25 * np.sin(5.0 * wx + 3.0 * wy + float(video))),
            past,
        )
    if camera.shadow is not None:
        angle, offset, factor = camera.shadow
        image *= 1.0 - (1.0 - factor) * smoothstep(
            math.cos(angle) * x + math.sin(angle) * y, offset, offset + 0.12
        )
    if camera.hand is not None:
        image = _hand(
            image,
            camera,
            scene.exposure,
            camera.hand + 0.02 * math.sin(0.2 * frame),
            0.10 + 0.55 * state.lift,
        )
    blur = camera.blur * size / 128.0
    if blur > 0.2:
        image = ndimage.gaussian_filter(image, (0.0, blur, blur), truncate=2.5)
    image = np.ascontiguousarray(np.moveaxis(image, 0, 2))
    image += rng.standard_normal((size, size, 3), dtype=np.float32) * np.float32(camera.noise)
    return np.clip(image, 0.0, 1.0) ** 0.8


def _hand(image: Array, camera: Camera, exposure: float, angle: float, tip: float) -> Array:
    """Shadow, sensor and two fingers and a back of the hand, entering along ``angle`` up to ``tip``
    half widths from the middle.
    """
    y, x = grid(image.shape[1])
    along, across = (
        math.cos(angle) * x + math.sin(angle) * y,
        math.cos(angle) * y - math.sin(angle) * x,
    )
    box = np.maximum(np.abs(across - 0.06) - 0.2, tip - 0.03 - along)
    image = image * (1.0 - 0.45 * smoothstep(box, 0.10, -0.06))
    body = np.maximum(np.abs(across) - 0.15, tip - along)
    case = f32([0.07, 0.07, 0.08])[:, None, None] + 0.9 * np.maximum(
        0.09 - np.abs(across - 0.03), 0.0
    )
    image = over(image, case, smoothstep(body, 0.02, -0.02))
    rim = np.maximum(np.abs(across) - 0.12, np.abs(along - tip - 0.02) - 0.02)
    image = over(image, f32([0.16, 0.4, 0.36]), smoothstep(rim, 0.01, -0.01))
    skin = camera.skin * min(1.2, exposure * 0.9)
    for middle, width, start in ((-0.20, 0.13, 0.24), (0.20, 0.13, 0.32), (0.0, 0.30, 0.68)):
        distance = np.hypot(np.minimum(along - (start + tip), 0.0), across - middle)
        round_ = np.sqrt(np.clip(1.0 - (distance * (1.0 / width)) ** 2, 0.0, 1.0))
        image = over(
            image,
            skin[:, None, None] * (0.45 + 0.6 * round_),
            smoothstep(distance, width, width * 0.86),
        )
    return image
