"""Reading and writing video: sources, trips, own speed, ffmpeg, the pipeline and the annotated video."""

from vehicle_detection.video.ffmpeg import VideoInfo
from vehicle_detection.video.horizon import estimate_video_horizon
from vehicle_detection.video.own_speed import OwnSpeed, read_own_speed
from vehicle_detection.video.pipeline import VideoDetector
from vehicle_detection.video.process import VideoReport, VideoRun, cut_video, process_video
from vehicle_detection.video.sources import (
    FrameSource,
    Source,
    download,
    list_files,
    open_filesystem,
    open_source,
    probe_video,
    read_frames,
    with_retries,
)
from vehicle_detection.video.trips import UNKNOWN_CAMERA, Trip, find_trips, is_video_file

__all__ = [
    "UNKNOWN_CAMERA",
    "FrameSource",
    "OwnSpeed",
    "Source",
    "Trip",
    "VideoDetector",
    "VideoInfo",
    "VideoReport",
    "VideoRun",
    "cut_video",
    "download",
    "estimate_video_horizon",
    "find_trips",
    "is_video_file",
    "list_files",
    "open_filesystem",
    "open_source",
    "probe_video",
    "process_video",
    "read_frames",
    "read_own_speed",
    "with_retries",
]
