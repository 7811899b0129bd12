"""Reading and writing video: ffmpeg, the threaded pipeline and the annotated video."""

from vehicle_detection.video.ffmpeg import VideoInfo
from vehicle_detection.video.horizon import estimate_video_horizon
from vehicle_detection.video.process import VideoReport, cut_video, probe_video, process_video, read_frames

__all__ = [
    "VideoInfo",
    "VideoReport",
    "cut_video",
    "estimate_video_horizon",
    "probe_video",
    "process_video",
    "read_frames",
]
