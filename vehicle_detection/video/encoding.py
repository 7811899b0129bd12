"""H.264 encoders of ffmpeg: x264, and those of graphics processors, with x264 in place of one that fails."""

from __future__ import annotations

import functools
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vehicle_detection._common import fields
from vehicle_detection.video.ffmpeg import exit_reason, run_ffmpeg

_LOGGER = logging.getLogger(__name__)

PRESETS = (
    "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow", "placebo",
)  # fmt: skip
"""Presets of x264, from the fastest to the one with the smallest files."""

ENCODERS = ("x264", "auto", "nvenc", "vaapi", "videotoolbox")
"""Encoders: on the processor; the first one that works; NVIDIA; Intel and AMD on Linux; macOS."""

_USUAL_CRF = 23  # of x264


@dataclass(frozen=True, kw_only=True)
class Encoding(fields.Checked):
    """How a video is encoded as H.264.

    Attributes
    ----------
    preset
        Speed of x264, from ``"ultrafast"`` (large files) to ``"placebo"`` (small ones); `PRESETS`.
    crf
        Quality, from 0 (best) to 51; 6 more give about half the size. None: the encoder's usual one, 23 of
        x264. The numbers of other encoders are similar, not equal.
    encoder
        ``"x264"``; ``"nvenc"``, ``"vaapi"`` or ``"videotoolbox"`` for graphics processors, which are faster
        with larger files; ``"auto"`` for one of these that works. x264 replaces one that does not work.

    >>> Encoding(preset="fast", crf=20).encoder
    'x264'
    """

    preset: str = fields.choice("veryfast", PRESETS)
    crf: int | None = fields.integer(None, low=0, high=51)
    encoder: Literal["x264", "auto", "nvenc", "vaapi", "videotoolbox"] = fields.choice("x264", ENCODERS)

    def options(self, filters: str) -> list[str]:
        """Return the options of ffmpeg that filter and encode frames, with an encoder that works."""
        wanted = self.encoder
        tried = ENCODERS[2:] if wanted == "auto" else (wanted,)
        failures = {name: _failure(name) for name in tried if name != "x264"}
        works = next((name for name in tried if not failures.get(name)), "x264")
        if works != wanted:
            reason = failures.get(wanted, "")
            _LOGGER.log(
                logging.WARNING if reason else logging.INFO,
                "encoding with %s%s",
                works,
                f", because {wanted} does not work here ({reason})" if reason else "",
            )
        return self._options(works, filters)

    def _options(self, encoder: str, filters: str) -> list[str]:
        quality = _USUAL_CRF if self.crf is None else self.crf
        if encoder == "nvenc":
            return ["-vf", filters, "-c:v", "h264_nvenc", "-rc", "vbr", "-cq", str(quality), "-b:v", "0"]
        if encoder == "vaapi":
            upload = ["-vaapi_device", "/dev/dri/renderD128", "-vf", f"{filters},format=nv12,hwupload"]
            return [*upload, "-c:v", "h264_vaapi", "-qp", str(quality)]
        if encoder == "videotoolbox":  # its quality is 1 to 100, the best
            return ["-vf", filters, "-c:v", "h264_videotoolbox", "-q:v", str(max(1, 100 - 2 * quality))]
        crf = [] if self.crf is None else ["-crf", str(self.crf)]
        return ["-vf", filters, "-c:v", "libx264", "-preset", self.preset, *crf]


@functools.cache
def _failure(encoder: str) -> str:
    """Why a few frames cannot be encoded; empty if they can."""
    frames = ("-f", "lavfi", "-i", "color=size=320x256:rate=25:duration=0.2")
    options = Encoding()._options(encoder, "null")
    code, log = run_ffmpeg(Path(encoder), (*frames, *options, "-f", "null", "-"), level="error")
    return exit_reason(code, log) if code else ""
