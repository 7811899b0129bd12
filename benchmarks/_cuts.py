"""Scene cuts on real material: none within a drive at any frame rate, one between two roads."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks._material import Context, data_folder
from benchmarks._report import Row, Target
from vehicle_detection import read_frames, read_image
from vehicle_detection.tracking import SceneCuts

CLIPS = {"project_clip": 25, "test_video": 25, "lane_lines_960x540": 25}
SEQUENCES = {"tusimple_a": 20, "tusimple_b": 20, "kitti_odo03": 10}
ROADS, PAIRS, SLOWEST = ("bdd", "camvid", "india", "indonesia", "dawn", "dhaka", "us_side"), 500, 5


def run(_: Context) -> list[Row]:
    """Count false cuts in drives, and pairs of frames of different roads that are no cut."""
    folder = data_folder()
    if folder is None:
        return []
    false = pairs = 0
    sources = {folder / f"videos/{name}.mp4": fps for name, fps in CLIPS.items()}
    sources |= {folder / f"sequences/{name}/frames": fps for name, fps in SEQUENCES.items()}
    for source, fps in sources.items():
        frames = list(map(read_image, sorted(source.iterdir()))) if source.is_dir() else _decode(source)
        for step in range(1, fps // SLOWEST + 1):
            for start in range(step):
                found = list(map(SceneCuts().update, frames[start::step]))
                false, pairs = false + sum(found), pairs + len(found) - 1
    random, missed, roads = np.random.default_rng(0), 0, 0
    for road in ROADS:
        files = sorted((folder / "frames" / road).iterdir())
        chosen = [read_image(file) for file in random.permutation(files)[:PAIRS]]
        missed += sum(not _is_cut(*pair) for pair in pairwise(chosen))
        roads += len(chosen) - 1
    within = "false cuts in drives at 5 to 25 frames/s"
    return [
        Row(within, false, target=Target("=", 0), material=f"{pairs} pairs"),
        Row("frames of different roads without a cut", missed, material=f"{roads} pairs"),
    ]


def _decode(video: Path) -> list[np.ndarray]:
    return [frame for _, _, frame in read_frames(video)]


def _is_cut(first: np.ndarray, second: np.ndarray) -> bool:
    cuts = SceneCuts()
    cuts.update(first)
    return cuts.update(second)
