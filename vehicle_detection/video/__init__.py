"""Reading and writing video: sources, ffmpeg, the engine that tracks, and the annotated video."""

from vehicle_detection.video.clips import annotate_clip
from vehicle_detection.video.engine import TrackRun, VideoDetector, VideoReport, track
from vehicle_detection.video.files import is_video_file, list_files, walk_files
from vehicle_detection.video.horizon import estimate_video_horizon
from vehicle_detection.video.opening import Source, borrow_source, open_source, probe_video, read_frames
from vehicle_detection.video.probe import VideoInfo
from vehicle_detection.video.remote import download, open_filesystem, with_retries
from vehicle_detection.video.sources import FrameSource
from vehicle_detection.video.viewer import Viewer, open_viewer
from vehicle_detection.video.writing import PRESETS, check_video_target, cut_video, process_video, write_video

__all__ = [
    "PRESETS",
    "FrameSource",
    "Source",
    "TrackRun",
    "VideoDetector",
    "VideoInfo",
    "VideoReport",
    "Viewer",
    "annotate_clip",
    "borrow_source",
    "check_video_target",
    "cut_video",
    "download",
    "estimate_video_horizon",
    "is_video_file",
    "list_files",
    "open_filesystem",
    "open_source",
    "open_viewer",
    "probe_video",
    "process_video",
    "read_frames",
    "track",
    "walk_files",
    "with_retries",
    "write_video",
]
