"""Reading and writing video: sources, trips, own speed, ffmpeg, the pipeline and the annotated video."""

from vehicle_detection.video.files import walk_files
from vehicle_detection.video.frame_source import FrameSource
from vehicle_detection.video.horizon import estimate_video_horizon
from vehicle_detection.video.own_speed import OwnSpeed, read_own_speed
from vehicle_detection.video.pipeline import VideoDetector
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.process import PRESETS, VideoReport, VideoRun, cut_video, process_video
from vehicle_detection.video.reading import probe_video, read_frames
from vehicle_detection.video.remote import download, open_filesystem, with_retries
from vehicle_detection.video.sources import Source, borrow_source, open_source
from vehicle_detection.video.trips import Trip, find_trips, is_video_file
from vehicle_detection.video.viewer import Viewer, open_viewer

__all__ = [
    "PRESETS",
    "FrameSource",
    "OwnSpeed",
    "Source",
    "Trip",
    "VideoDetector",
    "VideoInfo",
    "VideoReport",
    "VideoRun",
    "Viewer",
    "borrow_source",
    "cut_video",
    "download",
    "estimate_video_horizon",
    "find_trips",
    "is_video_file",
    "open_filesystem",
    "open_source",
    "open_viewer",
    "probe_video",
    "process_video",
    "read_frames",
    "read_own_speed",
    "walk_files",
    "with_retries",
]
