"""How a road scene is photographed: camera, frame size, light, lens and sensor; and operations on pixels."""

from __future__ import annotations

import functools
import importlib.resources
import json
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, fields
from vehicle_detection.camera import Camera

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Rng = np.random.Generator
Color = tuple[float, float, float]
Dtype = TypeVar("Dtype", bound=np.generic)


def wrapped_noise(rng: Rng, shape: tuple[int, int], *, falloff: float, stretch: float = 1.0) -> Floats:
    """Return noise with zero mean and unit variance that repeats seamlessly along both axes.

    Its amplitude falls with frequency to the power `falloff` (0: white noise, 2: smooth clouds); a `stretch`
    above 1 elongates it along the rows.
    """
    spectrum = np.fft.rfft2(rng.standard_normal(shape, dtype=np.float32))
    field = np.fft.irfft2(spectrum * _amplitudes(shape, falloff, stretch), s=shape)
    return np.asarray(field / field.std(), np.float32)


@functools.cache
def _amplitudes(shape: tuple[int, int], falloff: float, stretch: float) -> Floats:
    """Amplitude of each frequency of `wrapped_noise`; cached because few shapes are in use."""
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[0]
    fx = np.fft.rfftfreq(shape[1])[None, :] * shape[1] * stretch
    radius = np.hypot(fy, fx)
    radius[0, 0] = np.inf
    return np.asarray(radius**-falloff, np.float32)


def tile_to(tile: NDArray[Dtype], height: int, width: int) -> NDArray[Dtype]:
    """Repeat a seamless ``(h, w, ...)`` tile to `height` rows and `width` columns."""
    return tile.take(range(height), axis=0, mode="wrap").take(range(width), axis=1, mode="wrap")


def blend(target: Floats, color: NDArray[Any], alpha: NDArray[Any]) -> None:
    """Composite a color over `target` in place; `alpha` (0-1) is not yet multiplied into `color`."""
    target += alpha * (color - target)


def alpha_over(base: NDArray[Any], color: NDArray[Any], alpha: NDArray[Any]) -> Floats:
    """Composite a color that has been multiplied by `alpha` (0-1) over `base`."""
    return np.asarray(base * (1 - alpha) + color, np.float32)


_GRAIN_SIDE = 512  # side of the noise tile (px)


@dataclass(frozen=True)
class Light:
    """Light and weather of a scene, in 0-255 image values."""

    sky_top: Color  # color of the sky overhead
    sky_low: Color  # color of the sky at the horizon
    ambient: float  # gain of every surface
    sun: float  # additional gain of a surface that faces the sun
    to_sun: Color  # unit vector towards the sun: right, up, ahead
    tint: Color  # gain of each color channel
    lamps: float  # brightness of the vehicle lamps, 0-1
    visibility: float  # distance (m) at which haze has removed 63% of the contrast
    noise: float  # standard deviation of the sensor noise
    dark: bool = False  # night: only headlights illuminate the road

    @property
    def haze(self) -> Floats:
        """Color of the haze."""
        return np.asarray(self.sky_low, np.float32) * (1.0 if self.dark else 0.92)

    def transmission(self, distance: float) -> float:
        """Fraction of the contrast that remains at a distance (m)."""
        return float(np.exp(-max(distance, 0.0) / self.visibility))

    def headlight_gain(self, distance: float) -> float:
        """Gain of an upright surface at a distance (m): 1 by day, the camera car's headlights at night."""
        return min(1.0, 0.26 + 0.9 * float(np.exp(-max(distance, 0.0) / 40.0))) if self.dark else 1.0

    def shade(self, color: ArrayLike, distance: float = 0.0) -> Doubles:
        """Color of a surface in this light, seen through `distance` meters of haze."""
        gain = (self.ambient + 0.6 * self.sun) * (0.5 if self.dark else 1.0) * self.headlight_gain(distance)
        clear = self.transmission(distance)
        return np.asarray(color, np.float64) * (gain * clear) + self.haze * (1 - clear)


_FILE = importlib.resources.files("vehicle_detection.scenes") / "lights.json"
_LIGHTS: dict[str, dict[str, Any]] = json.loads(_FILE.read_bytes())
LIGHTS = tuple(_LIGHTS)


def make_light(name: str, rain: float, rng: Rng) -> Light:
    """Return one of `LIGHTS` with a random sun; rain weakens the sun and shortens the visibility."""
    side = rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.9)
    dusk = name == "dusk"
    sun = np.array([side, 0.35 if dusk else rng.uniform(0.7, 1.3), rng.uniform(-0.8, 0.3)])
    right, up, ahead = (sun / np.linalg.norm(sun)).tolist()
    to_sun = (right, up, ahead)
    # A pair is a range. Every preset draws its values: those of one do not depend on which is requested.
    for preset, values in _LIGHTS.items():
        pairs = {key: each for key, each in values.items() if isinstance(each, list) and len(each) == 2}
        drawn = values | {key: rng.uniform(*each) for key, each in pairs.items()}
        if preset == name:
            light = Light(to_sun=to_sun, **drawn)
    if rain == 0:
        return light
    gray = np.array([166.0, 172.0, 176.0]) * (0.16 if light.dark else 0.75 if dusk else 1.0)
    top, low = (
        tuple((np.array(sky) * (1 - 0.8 * rain) + gray * 0.8 * rain).tolist())
        for sky in (light.sky_top, light.sky_low)
    )
    return replace(
        light, sky_top=top, sky_low=low, ambient=light.ambient + 0.25 * light.sun * rain,
        sun=light.sun * (1 - 0.9 * rain), visibility=light.visibility / (1 + 2 * rain),
        noise=light.noise + 1.5 * rain,
    )  # fmt: skip


@dataclass(frozen=True)
class SceneConfig:
    """What all frames of a scene or drive have in common."""

    shape: tuple[int, int]  # height and width of the frame (px)
    camera: Camera
    light: Light
    rain: float = 0.0  # 0 (dry) to 1 (heavy)
    jpeg_quality: int | None = None  # None: the images are not compressed
    margin: int = 0  # rows drawn above and below the frame, for a camera that pitches
    seed: int = 0
    roll: float = 0.0  # rows by which the image falls per column to the right of the middle

    @property
    def center_px(self) -> float:
        """Column of the optical axis, the middle of the frame."""
        return self.shape[1] / 2

    def project(self, x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Doubles:
        """Columns and rows ``(..., 2)`` of points `x` m right, `y` m above the road and `z` > 0 m ahead."""
        right, up, ahead = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in (x, y, z)))
        camera = self.camera
        columns = self.center_px + camera.focal_px * right / ahead
        rows = camera.horizon_px + camera.focal_px * (camera.height_m - up) / ahead
        return np.stack([columns, rows], axis=-1)

    def pitched(self, offset: float, roll: float = 0.0) -> SceneConfig:
        """Return the configuration with the horizon `offset` rows lower, and rolled."""
        camera = replace(self.camera, horizon_px=self.camera.horizon_px + offset)
        return replace(self, camera=camera, roll=roll)

    def on_hill(self, slope: float) -> SceneConfig:
        """Return the configuration for a vehicle that a hill lifts by `slope` times its distance."""
        return self.pitched(-slope * self.camera.focal_px, self.roll) if slope else self


def _check_shape(shape: object, name: str) -> tuple[int, int]:
    sides = enumerate(check.shape(shape))
    height, width = (check.integer(size, f"{name}[{axis}]", low=64, high=4320) for axis, size in sides)
    return height, width


@dataclass(frozen=True, kw_only=True)
class SceneView(fields.Checked):
    """Options of a scene or drive: camera, light and weather."""

    shape: tuple[int, int] = fields.checked_field((720, 1280), _check_shape)  # height and width (px)
    horizon: float = fields.number(0.56, low=0.1, high=0.9)  # row as a fraction of the height
    camera_height_m: float = fields.number(1.3, low=0.5, high=5)
    focal_px: float | None = None  # None: 0.9 times the longer side
    light: str = fields.choice("day", LIGHTS)
    # From 0 (dry) to 1 (heavy): streaks, haze, less contrast, more noise.
    rain: float = fields.number(0.0, low=0, high=1)
    jpeg_quality: int | None = fields.integer(None, low=1, high=100)

    def configure(self, rng: Rng) -> SceneConfig:
        """Return the configuration with an exact camera, and a random sun and seed."""
        height, width = self.shape
        focal_px = 0.9 * max(self.shape)
        if self.focal_px is not None:
            focal_px = check.number(self.focal_px, "focal_px", low=0.2 * width, high=10.0 * width)
        camera = Camera(
            focal_px=focal_px, horizon_px=self.horizon * height, height_m=self.camera_height_m,
            focal_std=0.0, height_std_m=0.0, shape=self.shape,
        )  # fmt: skip
        seed = int(rng.integers(2**62))
        light = make_light(self.light, self.rain, np.random.default_rng([seed, 4]))
        return SceneConfig(self.shape, camera, light, self.rain, self.jpeg_quality, seed=seed)


def _tone_curve() -> NDArray[np.uint8]:
    """Lookup table of an S-shaped tone curve: darker shadows, brighter highlights."""
    contrast = 1.3
    power = np.log(0.5) / np.log(0.38)  # 0.38 is mapped to itself
    bent = (np.arange(256) / 255) ** power
    curve = bent**contrast / (bent**contrast + (1 - bent) ** contrast)
    return np.asarray(np.rint(255 * curve ** (1 / power)), np.uint8)


_TONE_CURVE = _tone_curve()


class Sensor:
    """Lens blur, vignette, rain and noise; they depend only on the image and the frame number."""

    def __init__(self, config: SceneConfig) -> None:
        self._config = config
        rng = np.random.default_rng([config.seed, 1])
        light, rain = config.light, config.rain
        height, width = config.shape
        row = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
        column = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
        vignette = (1 - 0.13 * (row**2 + column**2)) * 128
        # Vignette and tint are one multiplication per frame.
        gain = vignette[..., None] * np.asarray(light.tint, np.float32)
        self._gain = np.clip(gain, 0, 255).astype(np.uint8)
        self._blur = 0.42 * max(1.0, max(config.shape) / 1280) + 0.35 * rain
        luma = wrapped_noise(rng, (_GRAIN_SIDE, _GRAIN_SIDE), falloff=0.25)
        chroma = np.tile(rng.standard_normal((_GRAIN_SIDE // 2, _GRAIN_SIDE // 2, 3), np.float32), (2, 2, 1))
        grain = light.noise * (0.85 * luma[..., None] + 0.35 * cv2.GaussianBlur(chroma, (3, 3), 0.8) * 2)
        tile = np.clip(np.rint(grain), -127, 127).astype(np.int16)
        # One tile more than the frame along each axis, so that a random offset is a plain slice.
        self._grain = tile_to(tile, height + _GRAIN_SIDE, width + _GRAIN_SIDE)
        self._streaks = self._draw_streaks(rng) if rain > 0 else None

    def _draw_streaks(self, rng: Rng) -> Image:
        """Rain streaks, ``(2 * H, W)``."""
        height, width = self._config.shape
        streaks = np.zeros((height * 2, width), np.uint8)
        unit = max(height, width) / 1280
        for _ in range(int(2600 * self._config.rain)):
            x, y = rng.uniform(0, width), rng.uniform(0, height * 2)
            length = rng.uniform(5, 20) * unit
            end = (round(x + 0.16 * length), round(y + length))
            cv2.line(streaks, (round(x), round(y)), end, rng.uniform(10, 42), 1, cv2.LINE_AA)
        return np.asarray(cv2.GaussianBlur(streaks, (3, 3), 0.7), np.uint8)

    def expose(self, image: Image, frame: int, *, crop_blur: float | None = None) -> Image:
        """Turn a drawn image, or with the lens blur of a crop (px) a crop, into what the camera delivers."""
        rng = np.random.default_rng([self._config.seed, 2, frame])
        height, width = image.shape[:2]
        exposed = cv2.GaussianBlur(_develop(image), (0, 0), crop_blur or self._blur)
        if crop_blur is None:
            if self._streaks is not None:
                top = int(rng.integers(height))
                streaks = np.roll(self._streaks, int(rng.integers(width)), axis=1)[top : top + height]
                exposed = cv2.add(exposed, cv2.merge([streaks] * 3))
            exposed = cv2.multiply(exposed, self._gain, scale=1 / 128)
        top, left = rng.integers(_GRAIN_SIDE, size=2).tolist()
        grain = self._grain[top : top + height, left : left + width]
        return np.asarray(cv2.add(exposed, grain, dtype=cv2.CV_8U), np.uint8)


def _develop(image: Image) -> Image:
    """Apply the tone curve and chromatic aberration: red is drawn larger, blue smaller."""
    channels = list(cv2.split(cv2.LUT(image, _TONE_CURVE)))
    height, width = image.shape[:2]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for channel, grow in ((0, 0.0005), (2, -0.0005)):
        matrix = np.array([[1 - grow, 0, grow * width / 2], [0, 1 - grow, grow * height / 2]])
        channels[channel] = cv2.warpAffine(
            channels[channel], matrix, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    return np.asarray(cv2.merge(channels), np.uint8)
