"""The photo: a view of the object around the contact, with irrelevant variation.

It is 30 to 45 mm wide; in scale real ``view_mm`` of a ground, with the contact off the middle.

An object is lit once a video (sun, ambient light, occlusion in its pits, gloss, stains) on its
tile; a frame looks that tile up in perspective, adds the object's edge, a cast shadow, the hand
with the sensor, blur and noise.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from palpate.sim.arrays import Array, blend, f32, grid, hsv, over, smoothstep, turned, window
from palpate.sim.materials import Surface
from palpate.sim.motion import State
from palpate.sim.options import WorldOptions
from palpate.sim.tile import TILE_MM, wrapped_offset

#: Range of the width of the view in mm, log-uniform. Materials live on a periodic tile of 64 mm; a
#: view of w mm turned by 45 degrees is w sqrt(2) wide, so that at most 45.25 mm never show the
#: repeat.
VIEW_MM = (30.0, 45.0)
#: Range of the contact's place in views of scale real, along y and x, in half widths.
CONTACT_AT = ((-0.2, 0.75), (-0.2, 0.95))
#: Share of the views of scale real that are level; the view in mm that the hand is drawn for.
LEVEL, HAND_VIEW_MM = 0.7, 270.0
#: Range of the height of the light.
ELEVATION_DEG = (18.0, 75.0)
#: Shares of the videos with a hand, a cast shadow and the edge of the object in view, at hard 0.5.
HAND, SHADOW, EDGE = 0.6, 0.5, 0.35
#: Blurs in pixels at 128 px, one drawn a video.
BLUR_PX = (0.35, 0.6, 1.1)
#: Frequency, phase factor of the slow drift: tilt along x and y, rotation, distance.
SWAY = ((0.31, 1.0), (0.23, 2.0), (0.17, 3.0), (0.11, 5.0))


class Camera:
    """Light and camera of one video, and its photos.

    Everything that is irrelevant to contact is scaled by ``options.hard``. Angles are in radians,
    distances in the view in half widths.

    Attributes:
        view: width of the view in mm.
        at: y and x of the contact in the view.
        saturation: of the colors, a factor.
        turn, tilt: of the camera.
        sun_to: unit vector towards the sun.
        sun, ambient: strengths of the sun and of the ambient light.
        light: RGB of the light.
        exposure: error of the auto-exposure, a factor.
        blur: deviation in pixels at 128 px.
        noise: deviation.
        hand: direction it enters from, or None.
        skin: color of the hand.
        shadow: direction, offset and factor of a cast shadow, or None.
        edge: direction and distance of the object's edge, or None.
        beyond: color behind the edge.
    """

    def __init__(self, options: WorldOptions, video: int) -> None:
        rng = options.rng("camera", video)
        draw, scale, circle = rng.uniform, 2.0 * options.hard, 2.0 * math.pi
        happens = lambda share: rng.random() < min(0.95, share * scale)
        lean = lambda: max(-0.5, min(0.5, rng.normal(0.0, 0.2 * min(1.4, scale) + 1e-9)))
        self.options, self.video = options, video
        elevation, azimuth = math.radians(draw(*ELEVATION_DEG)), draw(0.0, circle)
        warm = draw(-1.0, 1.0) * scale
        real = options.scale == "real"
        near, far = map(math.log, options.view_mm if real else VIEW_MM)
        reach = draw(-0.5, 0.5) * (far - near) * min(1.0, 0.4 + 0.6 * scale)
        self.view = math.exp((near + far) / 2.0 + reach)
        hand, hand_from = happens(HAND), draw(0.0, circle)
        self.hand = hand_from if hand else None
        shadow = happens(SHADOW)
        shadow_at = (draw(0.0, math.pi), draw(-0.6, 0.6), draw(0.35, 0.75))
        self.shadow = shadow_at if shadow else None
        edge, edge_at = happens(EDGE), (draw(0.0, circle), draw(0.25, 0.75))
        self.edge = edge_at if edge else None
        bare = rng.random() < 0.6
        skin = hsv(draw(0.03, 0.08), draw(0.25, 0.55), draw(0.25, 0.9))
        glove = hsv(rng.random(), 0.2, draw(0.08, 0.5))
        self.skin = skin if bare else glove
        flat, warmth = math.cos(elevation), np.array([1.0 + 0.13 * warm, 1.0, 1.0 - 0.13 * warm])
        self.turn, self.tilt = draw(0.0, circle), (lean(), lean())
        self.sun_to = math.cos(azimuth) * flat, math.sin(azimuth) * flat, math.sin(elevation)
        self.sun, self.ambient = draw(0.25, 1.0), draw(0.35, 0.8)
        self.light = f32(warmth * np.exp(rng.normal(0.0, 0.03 * scale + 1e-9, 3)))
        self.exposure = math.exp(rng.normal(0.0, 0.2 * scale + 1e-9))
        self.blur = BLUR_PX[int(rng.integers(len(BLUR_PX)))]
        self.noise = draw(0.004, 0.01 + 0.018 * options.hard)
        self.beyond = hsv(rng.random(), draw(0.05, 0.6), draw(0.15, 0.85))
        self.at, self.saturation, self.hand_size = (0.0, 0.0), 1.0, 1.0
        if real:
            self._stand_back(rng)

    def _stand_back(self, rng: np.random.Generator) -> None:
        """Draw what views of scale real have beside: most are level, a hand comes from below."""
        y, x = self.at = rng.uniform(*CONTACT_AT[0]), rng.uniform(*CONTACT_AT[1])
        level, lean = rng.random() < LEVEL, rng.normal(0.0, 0.12)
        self.turn = lean if level else self.turn
        self.saturation, self.hand_size = rng.uniform(0.5, 1.3), HAND_VIEW_MM / self.view
        if self.hand is not None:
            self.hand = math.pi / 2.0 + rng.normal(0.0, 0.5)
        if self.edge is not None:  # the contact is on this side of it
            angle, distance = self.edge
            beyond = math.cos(angle) * x + math.sin(angle) * y > distance - 0.1
            self.edge = angle + math.pi * beyond, distance

    def _stained(self, albedo: Array, number: int) -> Array:
        """Add stains and stickers to an albedo: elliptic spots that are seen but not felt."""
        rng = self.options.rng("stains", self.video, number)
        draw, at = rng.uniform, f32(np.arange(len(albedo)) * (TILE_MM / len(albedo)))
        count = round((0, 0, 1, 2, 5)[int(rng.integers(5))] * 2.0 * self.options.hard)
        for _ in range(count):
            y, x = draw(0.0, TILE_MM), draw(0.0, TILE_MM)
            radius, aspect, angle = draw(1.0, 6.0), draw(0.4, 1.6), draw(0.0, math.pi)
            color = hsv(rng.random(), draw(0.2, 1.0), draw(0.1, 1.0))
            u, v = turned(wrapped_offset(at[:, None], y), wrapped_offset(at[None], x), angle)
            spot = smoothstep(np.hypot(u * (1.0 / aspect), v), radius, radius * 0.9)
            albedo = blend(albedo, color, spot * draw(0.4, 1.0))
        return albedo

    def light_object(self, surface: Surface, number: int) -> tuple[Array, float, float]:
        """Light object ``number`` of the video.

        Returns:
            Its tile, or its ground, (3, n, n) as seen, the exposure, and the pixel size in mm.
        """
        surface = surface.ground or surface
        height, px = surface.height, surface.px
        softened = scipy.ndimage.gaussian_filter(height, 0.6, mode="wrap")
        slope_y, slope_x = (
            (np.roll(softened, -1, axis) - np.roll(softened, 1, axis)) * (0.5 / px)
            for axis in (0, 1)
        )
        upright = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        lx, ly, lz = self.sun_to
        direct = np.maximum((lz - slope_x * lx - slope_y * ly) * upright, 0.0)
        pit = height - scipy.ndimage.gaussian_filter(height, 1.2 / px, mode="wrap")
        open_sky = np.clip(1.0 + 0.55 * pit * (1.0 / (0.35 + float(height.std()))), 0.35, 1.25)
        half_way = ((lz + 1.0) - slope_x * lx - slope_y * ly) * upright
        norm = math.sqrt(lx * lx + ly * ly + (lz + 1.0) ** 2)
        mirror = np.maximum(half_way * (1.0 / norm), 0.0) ** 60
        albedo = self._stained(surface.albedo, number)
        rgb = albedo * (self.ambient * open_sky + self.sun * direct)[..., None] * self.light
        rgb += (mirror * (surface.gloss * 0.55 * self.sun))[..., None]
        gray = rgb.mean(2, keepdims=True)
        rgb = gray + (rgb - gray) * self.saturation if self.saturation != 1.0 else rgb
        # The power makes the auto-exposure imperfect, so that dark objects stay darker.
        exposure = (0.40 * self.exposure / (0.12 + float(rgb.mean()))) ** 0.75
        blur = max(0.3, 0.42 * min(self.view, surface.side_mm) / self.options.size / px)
        lit = np.ascontiguousarray(np.moveaxis(rgb * exposure, 2, 0))
        lit = scipy.ndimage.gaussian_filter(lit, (0, blur, blur), mode="wrap", truncate=3.0)
        return lit, exposure, px

    def photo(self, tile: Array, exposure: float, px: float, state: State, frame: int) -> Array:
        """Render a frame, (n, n, 3), about [0, 1], from no other; see :meth:`light_object`."""
        rng, size = self.options.rng("photo", self.video, frame), self.options.size
        y, x = grid(size)
        sway = [0.012 * math.sin(w * frame + self.video * p) for w, p in SWAY]
        depth = 1.0 + x * (self.tilt[0] + sway[0]) + y * (self.tilt[1] + sway[1])
        wy, wx = y / depth, x / depth
        view = min(self.view, px * tile.shape[-1])  # no scan shows its repeat
        reach = view / 2.0 * (1.0 + sway[3]) / px
        shift_x, shift_y = rng.normal(0.0, 0.004) * reach, rng.normal(0.0, 0.004) * reach
        center = state.position[0] / px + shift_x, state.position[1] / px + shift_y
        seen = wy - self.at[0], wx - self.at[1]
        image = window(tile, seen, self.turn + sway[2], reach, center)
        if self.edge is not None:
            angle, distance = self.edge
            past = smoothstep(turned(wy, wx, angle)[0], distance, distance + 0.03)
            shading = 0.8 + 0.25 * np.sin(5.0 * wx + 3.0 * wy + float(self.video))
            image = over(image, self.beyond[:, None, None] * shading, past)
        if self.shadow is not None:
            angle, offset, factor = self.shadow
            dark = smoothstep(turned(y, x, angle)[0], offset, offset + 0.12)
            image *= 1.0 - (1.0 - factor) * dark
        if self.hand is not None:
            angle, tip = self.hand + 0.02 * math.sin(0.2 * frame), 0.10 + 0.55 * state.lift
            down, right = self.at
            place = turned((y - down) / self.hand_size, (x - right) / self.hand_size, angle)
            image = _hand(image, self.skin * min(1.2, exposure * 0.9), place, tip)
        blur = self.blur * size / 128.0
        if blur > 0.2:
            image = scipy.ndimage.gaussian_filter(image, (0, blur, blur), truncate=2.5)
        image = np.ascontiguousarray(np.moveaxis(image, 0, 2))
        image += rng.standard_normal((size, size, 3), dtype=np.float32) * np.float32(self.noise)
        return np.clip(image, 0.0, 1.0) ** 0.8


def _hand(image: Array, skin: Array, place: tuple[Array, Array], tip: float) -> Array:
    """Draw a hand with the sensor, and its shadow, up to ``tip``.

    ``place``: how far each pixel lies along and across the direction that it enters from.
    """
    along, across = place
    box = np.maximum(np.abs(across - 0.06) - 0.2, tip - 0.03 - along)
    image = image * (1.0 - 0.45 * smoothstep(box, 0.10, -0.06))
    body = np.maximum(np.abs(across) - 0.15, tip - along)
    sheen = 0.9 * np.maximum(0.09 - np.abs(across - 0.03), 0.0)
    image = over(
        image, f32([0.07, 0.07, 0.08])[:, None, None] + sheen, smoothstep(body, 0.02, -0.02)
    )
    rim = np.maximum(np.abs(across) - 0.12, np.abs(along - tip - 0.02) - 0.02)
    image = over(image, f32([0.16, 0.4, 0.36]), smoothstep(rim, 0.01, -0.01))
    for middle, width, start in ((-0.20, 0.13, 0.24), (0.20, 0.13, 0.32), (0.0, 0.30, 0.68)):
        distance = np.hypot(np.minimum(along - (start + tip), 0.0), across - middle)
        bulge = np.sqrt(np.clip(1.0 - (distance * (1.0 / width)) ** 2, 0.0, 1.0))
        shaded = skin[:, None, None] * (0.45 + 0.6 * bulge)
        image = over(image, shaded, smoothstep(distance, width, width * 0.86))
    return image
