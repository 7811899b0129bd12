"""Video in and out: ffmpeg, the threaded pipeline, and the annotated video."""

from vehicle_detection.video.horizon import clip_horizon
from vehicle_detection.video.process import VideoReport, probe_video, process_video, read_frames

__all__ = [
    "VideoReport",
    "clip_horizon",
    "probe_video",
    "process_video",
    "read_frames",
]
