from .clips import annotate_clip
from .engine import TrackRun, VideoDetector, VideoReport, track
from .files import (
    download,
    is_video_file,
    list_files,
    open_filesystem,
    select_videos,
    walk_files,
    with_retries,
)
from .horizon import estimate_video_horizon
from .opening import Source, borrow_source, open_source, probe_video, read_frames
from .probe import VideoInfo
from .sources import FrameSource
from .viewer import Viewer, open_viewer
from .writing import PRESETS, Encoding, check_video_target, cut_video, process_video, write_video

__all__ = [
    "PRESETS",
    "Encoding",
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
    "select_videos",
    "track",
    "walk_files",
    "with_retries",
    "write_video",
]
