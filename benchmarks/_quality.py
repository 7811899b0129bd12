"""Size, quality and processor time of encoded videos, by preset and quality of x264."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from benchmarks._limits import _run
from benchmarks._material import Context, clip, ffmpeg
from benchmarks._report import Row

PRESETS = ("ultrafast", "veryfast", "medium", "slow")
QUALITIES = (18, 23, 28)
FRAMES = 100


def run(context: Context) -> list[Row]:
    """Encode frames with each preset at the default quality, and with the default preset at others."""
    source, material = clip(context.work)
    settings = [(preset, 23) for preset in PRESETS] + [("veryfast", crf) for crf in QUALITIES if crf != 23]
    return [row for preset, crf in settings for row in _measure(source, material, context.work, preset, crf)]


def _measure(source: Path, material: str, work: Path, preset: str, crf: int) -> list[Row]:
    target = work / f"{preset} {crf}.mp4"
    decode = [ffmpeg(), "-v", "error", "-y", "-i", str(source), "-an", "-frames:v", str(FRAMES)]
    encode = [*decode, "-c:v", "libx264", "-preset", preset, "-crf", str(crf), str(target)]
    _, decoding = _run([*decode, "-f", "null", "-"])
    _, both = _run(encode)
    compare = [ffmpeg(), "-i", str(target), "-i", str(source), "-frames:v", str(FRAMES), "-lavfi", "ssim"]
    report = subprocess.run([*compare, "-f", "null", "-"], capture_output=True, text=True, check=True).stderr
    found = re.search(r"SSIM.*All:([\d.]+)", report)
    if found is None:
        raise AssertionError("ffmpeg has reported no SSIM")
    name = f"--preset {preset} --crf {crf}"
    return [
        Row(f"{name}: size", target.stat().st_size / FRAMES / 1e3, unit="kB/frame", material=material),
        Row(f"{name}: SSIM to the source", float(found[1]), unit=""),
        Row(f"{name}: encoding", (both - decoding) / FRAMES * 1e3, unit="ms/frame"),
    ]
