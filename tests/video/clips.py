"""Test clips, and what they contain."""

import contextlib
import subprocess
import threading
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from moviepy.config import FFMPEG_BINARY

from vehicle_detection.video import read_frames

LEVELS = 10  # gray levels from one frame of a test clip to the next: much more than the codec's errors
NTSC = Fraction(30000, 1001)


def ffmpeg(*options, data=None):
    command = [FFMPEG_BINARY, "-v", "error", "-y", *map(str, options)]
    return subprocess.run(command, input=data, capture_output=True, check=True).stdout


def ffmpeg_log(path):
    """Return ffmpeg's description of a file."""
    command = [FFMPEG_BINARY, "-hide_banner", "-i", str(path)]
    return subprocess.run(command, capture_output=True, text=True).stderr


def write_clip(path, frames, *, fps=25, sound=False, options=()):
    height, width = frames[0].shape[:2]
    video = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", fps, "-i", "pipe:0"]
    tone = ["-f", "lavfi", "-t", float(len(frames) / Fraction(fps)), "-i", "sine=440"] if sound else []
    encoder = ["-c:v", "libx264", "-preset", "ultrafast", "-crf", 4, "-pix_fmt", "yuv420p"]
    ffmpeg(*video, *tone, *encoder, *options, path, data=b"".join(frame.tobytes() for frame in frames))
    return path


def gray_frames(count, width=64, height=48):
    return [np.full((height, width, 3), 10 + LEVELS * n, np.uint8) for n in range(count)]


def frame_numbers(path):
    """Return which frames of `gray_frames` a video contains, from their brightness."""
    with read_frames(path) as frames:
        return [round((float(frame[8:-8, 8:-8].mean()) - 10) / LEVELS) for _, _, frame in frames]


def sound_seconds(path):
    return len(ffmpeg("-i", path, "-map", "0:a:0", "-f", "s16le", "-ac", 1, "-ar", 8000, "-")) / 16000


def write_beep(path, *, delay=0.0, longer=0.2, options=()):
    """Write a video of 24 frames, one second, with a beep 0.6 s after the first frame.

    The frames begin `delay` seconds after the sound, which is `longer` than they are.
    """
    early, late = max(delay, 0.0), max(-delay, 0.0)
    beep = f"sin(6000*t)*between(t,{0.6 + early - late},{0.7 + early - late})"
    flat = write_clip(path.with_name(f"pictures_{path.stem}.mp4"), gray_frames(24), fps=24, options=options)
    tone = ["-itsoffset", late, "-f", "lavfi", "-t", 1 + longer + early, "-i", f"aevalsrc='{beep}'"]
    ffmpeg("-itsoffset", early, "-i", flat, *tone, "-c:v", "copy", "-c:a", "aac", path)
    return path


def beeps(path):
    """Return the times in seconds at which the beeps of a video begin."""
    synchronized = ["-af", "aresample=async=1:first_pts=0:min_hard_comp=0.01"]
    data = ffmpeg("-i", path, "-map", "0:a:0", *synchronized, "-f", "s16le", "-ac", 1, "-ar", 8000, "-")
    power = np.convolve(np.frombuffer(data, np.int16).astype(float) ** 2, np.ones(80) / 80, "same")
    loud = power > 3000**2
    return (np.flatnonzero(loud[1:] & ~loud[:-1]) / 8000).tolist()


def child_processes():
    tasks = Path("/proc/self/task")
    if not tasks.is_dir():
        pytest.skip("processes cannot be listed without /proc")
    found = set()
    for task in tasks.iterdir():
        with contextlib.suppress(FileNotFoundError):  # the thread has ended
            found.update((task / "children").read_text().split())
    return found


def running_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("vehicle-")]


def damage_sizes(path, target, *, entry, byte=3, flip=0x7F):
    """Copy an MP4 with one wrong size in the table of its frames' sizes, after which frames are lost."""
    data = bytearray(path.read_bytes())
    table = data.index(b"stsz") + 16
    data[table + 4 * entry + byte] ^= flip
    target.write_bytes(data)
    return target


def damage_frames(path, target):
    """Copy an MP4 with flipped bits in its frames, but not in its index."""
    data = bytearray(path.read_bytes())
    start, stop = data.index(b"mdat") + 8, len(data)
    if data.index(b"moov") > start:
        stop = data.index(b"moov")
    for place in range(start + (stop - start) // 3, stop, max((stop - start) // 9, 1)):
        data[place] ^= 0x10
    target.write_bytes(data)
    return target
