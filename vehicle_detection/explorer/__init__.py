"""The interactive explorer for notebooks."""

from vehicle_detection.explorer.explorer import Explorer

__all__ = ["Explorer"]
