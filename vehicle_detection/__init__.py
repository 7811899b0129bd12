"""Classical vehicle detection and tracking in dash-cam images and video."""

__version__ = "0.1.0"
