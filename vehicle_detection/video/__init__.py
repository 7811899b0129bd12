"""Video in and out: ffmpeg, the threaded pipeline, and the annotated video."""

from vehicle_detection.video.horizon import estimate_video_horizon
from vehicle_detection.video.process import VideoReport, probe_video, process_video, read_frames

__all__ = [
    "VideoReport",
    "estimate_video_horizon",
    "probe_video",
    "process_video",
    "read_frames",
]
