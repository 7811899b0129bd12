"""What stands between a drawn road and its picture: camera, light, noise, sensor."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float32]
Color = tuple[float, float, float]

_NOISE_SIDE = 512
_CONTRAST = 1.3
_MIDDLE = 0.38
_FRINGE = 0.0005


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera over a flat road, looking along it.

    A point `x` meters to the right, `y` meters above the road and `z` meters ahead is seen in column
    ``center_px + focal_px * x / z`` and row
    ``horizon_px + focal_px * (height_m - y) / z``.

    Attributes
    ----------
    focal_px
        Focal length in pixels.
    center_px
        Column of the optical axis, in pixels.
    horizon_px
        Row of the horizon, in pixels.
    height_m
        Height of the camera over the road, in meters.

    Examples
    --------
    >>> camera = Pinhole(focal_px=1152.0, center_px=640.0, horizon_px=403.2, height_m=1.3)
    >>> round(camera.foot_row(20.0), 2), round(camera.distance(478.08), 2)
    (478.08, 20.0)
    """

    focal_px: float
    center_px: float
    horizon_px: float
    height_m: float

    def foot_row(self, distance: float) -> float:
        """Row where something `distance` meters ahead touches the road."""
        return self.horizon_px + self.focal_px * self.height_m / distance

    def distance(self, row: float) -> float:
        """Metres to the road seen in a row below the horizon; the inverse of `foot_row`."""
        return self.focal_px * self.height_m / (row - self.horizon_px)

    def project(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> NDArray[np.float64]:
        """Columns and rows, ``(..., 2)``, of points in meters with ``z > 0``."""
        right, up, ahead = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in (x, y, z)))
        return np.stack(
            [
                self.center_px + self.focal_px * right / ahead,
                self.horizon_px + self.focal_px * (self.height_m - up) / ahead,
            ],
            axis=-1,
        )


@dataclass(frozen=True)
class Light:
    """How a scene is lit, in the 0-255 values of the picture.

    Attributes
    ----------
    sky_top, sky_low
        Colors of the sky overhead and at the horizon.
    ambient, sun
        Gain of a surface from all around and from the sun, if it faces it.
    to_sun
        Unit vector towards the sun: right, up, ahead.
    tint
        Gain of each color channel.
    lamps
        0-1, how brightly the vehicles' lamps shine.
    visibility
        Metres after which haze has taken 63% of the contrast.
    noise
        Standard deviation of the sensor's noise.
    dark
        True at night: only headlights reach the road.
    """

    sky_top: Color
    sky_low: Color
    ambient: float
    sun: float
    to_sun: Color
    tint: Color
    lamps: float
    visibility: float
    noise: float
    dark: bool = False

    @property
    def haze(self) -> Floats:
        """Color of the far distance."""
        return np.asarray(self.sky_low, np.float32) * (1.0 if self.dark else 0.92)

    def clarity(self, distance: float) -> float:
        """Share of the contrast left at a distance in meters."""
        return float(np.exp(-max(distance, 0.0) / self.visibility))

    def on(self, color: ArrayLike, ahead: float = 0.0) -> NDArray[np.float64]:
        """Return a color in this light, through the haze of `ahead` meters."""
        gain = (self.ambient + 0.6 * self.sun) * (0.5 if self.dark else 1.0) * self.reach(ahead)
        clear = self.clarity(ahead)
        return np.asarray(color, np.float64) * (gain * clear) + self.haze * (1 - clear)

    def reach(self, distance: float) -> float:
        """Gain of an upright surface at a distance: 1 by day, by headlight at night."""
        return min(1.0, 0.26 + 0.9 * float(np.exp(-max(distance, 0.0) / 40.0))) if self.dark else 1.0


LIGHTS = ("day", "overcast", "dusk", "night")


def make_light(name: str, rain: float, rng: np.random.Generator) -> Light:
    """One of `LIGHTS` with a random sun; rain takes the sun and the view."""
    side = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.9))
    low = name == "dusk"
    sun = np.array([side, 0.35 if low else rng.uniform(0.7, 1.3), rng.uniform(-0.8, 0.3)])
    to_sun = tuple((sun / np.linalg.norm(sun)).tolist())
    looks: dict[str, dict[str, Any]] = {
        "day": {
            "sky_top": (74, 122, 178),
            "sky_low": (178, 202, 220),
            "ambient": rng.uniform(0.56, 0.68),
            "sun": rng.uniform(0.45, 0.6),
            "tint": (1.02, 1.0, 0.98),
            "lamps": 0.0,
            "visibility": 900.0,
            "noise": 2.2,
        },
        "overcast": {
            "sky_top": (168, 176, 182),
            "sky_low": (206, 210, 212),
            "ambient": rng.uniform(0.74, 0.86),
            "sun": 0.1,
            "tint": (0.98, 1.0, 1.0),
            "lamps": 0.1,
            "visibility": 500.0,
            "noise": 2.6,
        },
        "dusk": {
            "sky_top": (92, 104, 138),
            "sky_low": (222, 172, 128),
            "ambient": rng.uniform(0.5, 0.58),
            "sun": 0.22,
            "tint": (1.06, 0.98, 0.92),
            "lamps": 0.6,
            "visibility": 500.0,
            "noise": 3.2,
        },
        "night": {
            "sky_top": (10, 12, 20),
            "sky_low": (30, 30, 36),
            "ambient": 0.8,
            "sun": 0.0,
            "tint": (1.0, 0.96, 0.88),
            "lamps": 1.0,
            "visibility": 400.0,
            "noise": 4.0,
            "dark": True,
        },
    }
    look = looks[name]
    if rain > 0:
        gray = np.array([166.0, 172.0, 176.0]) * (0.16 if name == "night" else 0.75 if low else 1.0)
        for key in ("sky_top", "sky_low"):
            look[key] = tuple((np.array(look[key]) * (1 - 0.8 * rain) + gray * 0.8 * rain).tolist())
        look["ambient"] += 0.25 * look["sun"] * rain
        look["sun"] *= 1 - 0.9 * rain
        look["visibility"] /= 1 + 2 * rain
        look["noise"] += 1.5 * rain
    return Light(to_sun=to_sun, **look)


def wrapped_noise(
    rng: np.random.Generator, shape: tuple[int, int], *, falloff: float, stretch: float = 1.0
) -> Floats:
    """Noise with zero mean and unit deviation that repeats seamlessly in both axes.

    Its amplitude falls with frequency to the power `falloff` (0 is white, 2 is smooth clouds);
    `stretch` above 1 draws it out along the rows.
    """
    spectrum = np.fft.rfft2(rng.standard_normal(shape, dtype=np.float32)) * _spectrum(shape, falloff, stretch)
    field = np.fft.irfft2(spectrum, s=shape)
    return np.asarray(field / field.std(), np.float32)


@functools.cache
def _spectrum(shape: tuple[int, int], falloff: float, stretch: float) -> Floats:
    """Amplitude by frequency; a handful of shapes is used over and over."""
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[0]
    fx = np.fft.rfftfreq(shape[1])[None, :] * shape[1] * stretch
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    return np.asarray(radius**-falloff, np.float32)


def _tone_curve() -> NDArray[np.uint8]:
    """Make a film's S-shaped curve: shadows deepen, lights brighten."""
    value = np.arange(256) / 255
    power = np.log(0.5) / np.log(_MIDDLE)
    bent = value**power
    curve = bent**_CONTRAST / (bent**_CONTRAST + (1 - bent) ** _CONTRAST)
    return np.asarray(np.rint(255 * curve ** (1 / power)), np.uint8)


_TONES = _tone_curve()


class Sensor:
    """Lens blur, vignette, rain and noise, which depend on the picture and the frame number alone."""

    def __init__(self, shape: tuple[int, int], light: Light, rain: float, seed: int) -> None:
        self._shape = shape
        self._rain = rain
        self._seed = seed
        rng = np.random.default_rng([seed, 1])
        height, width = shape
        row = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
        column = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
        gain = (1 - 0.13 * (row**2 + column**2)) * 128
        # Rows of the tint's gain times the vignette's: one multiplication a frame does both.
        tinted = gain[..., None] * np.asarray(light.tint, np.float32)
        self._gain = np.clip(tinted, 0, 255).astype(np.uint8)
        self._sigma = 0.42 * max(1.0, max(shape) / 1280) + 0.35 * rain
        luma = wrapped_noise(rng, (_NOISE_SIDE, _NOISE_SIDE), falloff=0.25)
        chroma = np.tile(rng.standard_normal((_NOISE_SIDE // 2, _NOISE_SIDE // 2, 3), np.float32), (2, 2, 1))
        grain = light.noise * (0.85 * luma[..., None] + 0.35 * cv2.GaussianBlur(chroma, (3, 3), 0.8) * 2)
        tile = np.clip(np.rint(grain), -127, 127).astype(np.int16)
        # One tile more than the frame on each axis, so that any offset is a plain slice.
        turns = (height // _NOISE_SIDE + 2, width // _NOISE_SIDE + 2, 1)
        self._grain = np.tile(tile, turns)[: height + _NOISE_SIDE, : width + _NOISE_SIDE]
        self._streaks = self._draw_streaks(rng) if rain > 0 else None

    def _draw_streaks(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        height, width = self._shape
        sheet = np.zeros((height * 2, width), np.uint8)
        unit = max(self._shape) / 1280
        for _ in range(int(2600 * self._rain)):
            x, y = rng.uniform(0, width), rng.uniform(0, height * 2)
            length = rng.uniform(5, 20) * unit
            end = (round(x + 0.16 * length), round(y + length))
            cv2.line(sheet, (round(x), round(y)), end, float(rng.uniform(10, 42)), 1, cv2.LINE_AA)
        return np.asarray(cv2.GaussianBlur(sheet, (3, 3), 0.7), np.uint8)

    def _develop(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Add the film's contrast and the lens's color fringes: red is drawn larger, blue smaller."""
        channels = list(cv2.split(cv2.LUT(image, _TONES)))
        height, width = image.shape[:2]
        for channel, grow in ((0, _FRINGE), (2, -_FRINGE)):
            matrix = np.array([[1 - grow, 0, grow * width / 2], [0, 1 - grow, grow * height / 2]])
            channels[channel] = cv2.warpAffine(
                channels[channel],
                matrix,
                (width, height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
        return np.asarray(cv2.merge(channels), np.uint8)

    def expose(self, image: NDArray[np.uint8], frame: int) -> NDArray[np.uint8]:
        """Turn a drawn ``(H, W, 3)`` image into the picture that the camera hands out."""
        rng = np.random.default_rng([self._seed, 2, frame])
        height, width = self._shape
        seen = cv2.GaussianBlur(self._develop(image), (0, 0), self._sigma)
        if self._streaks is not None:
            start = int(rng.integers(height))
            streaks = np.roll(self._streaks, int(rng.integers(width)), axis=1)[start : start + height]
            seen = cv2.add(seen, cv2.merge([streaks] * 3))
        seen = cv2.multiply(seen, self._gain, scale=1 / 128)
        top, left = (int(value) for value in rng.integers(_NOISE_SIDE, size=2))
        grain = self._grain[top : top + height, left : left + width]
        return np.asarray(cv2.add(seen, grain, dtype=cv2.CV_8U), np.uint8)

    def expose_part(self, part: NDArray[np.uint8], frame: int, *, blur: float) -> NDArray[np.uint8]:
        """As `expose` for a part of a picture, without vignette: lens blur and noise."""
        rng = np.random.default_rng([self._seed, 2, frame])
        seen = cv2.GaussianBlur(self._develop(part), (0, 0), blur)
        top, left = (int(value) for value in rng.integers(_NOISE_SIDE, size=2))
        grain = self._grain[top : top + part.shape[0], left : left + part.shape[1]]
        return np.asarray(cv2.add(seen, grain, dtype=cv2.CV_8U), np.uint8)
