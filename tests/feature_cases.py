"""Patches for the tests of features."""

import cv2
import numpy as np

BLANK = np.zeros((64, 64, 3), np.uint8)


def make_patches():
    """Patches of noise, uniform color, edges, ramps and blurred shapes."""
    rng = np.random.default_rng(7)
    noise = rng.integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)
    flat = [np.full((64, 64, 3), value, np.uint8) for value in (0, 255, (10, 200, 90))]
    smooth = [cv2.GaussianBlur(patch, (0, 0), sigma) for patch, sigma in zip(noise, (1, 2, 4, 8))]
    ramp = np.arange(64, dtype=np.uint8)
    ramps = [
        np.broadcast_to((ramp * 4)[:, None, None], (64, 64, 3)),
        np.broadcast_to((255 - ramp * 4)[None, :, None], (64, 64, 3)),
        # Both gradients are equal everywhere: 45 and 135 degrees, on the bounds of 4, 8 and 12 bins.
        np.repeat((ramp[:, None] + ramp[None, :])[..., None], 3, axis=2),
        np.repeat((ramp[:, None] + ramp[None, ::-1])[..., None], 3, axis=2),
    ]
    few_values = rng.choice(np.array([0, 1, 4, 9, 64, 255], np.uint8), (3, 64, 64, 3))
    checks = np.kron(rng.integers(0, 2, (8, 8, 1)), np.ones((8, 8, 3))).astype(np.uint8) * 255
    drawn = np.full((64, 64, 3), 120, np.uint8)
    cv2.rectangle(drawn, (8, 20), (56, 50), (180, 20, 30), -1)
    cv2.circle(drawn, (18, 50), 7, (15, 15, 15), -1)
    cv2.circle(drawn, (46, 50), 7, (15, 15, 15), -1)
    cv2.line(drawn, (12, 20), (24, 8), (230, 230, 240), 2, cv2.LINE_AA)
    photo = np.clip(smooth[2].astype(int) // 2 + rng.normal(60, 6, (64, 64, 3)), 0, 255).astype(np.uint8)
    return np.stack([*noise[4:], *flat, *smooth, *ramps, *few_values, checks, drawn, photo])


PATCHES = make_patches()
