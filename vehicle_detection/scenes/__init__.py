"""Synthetic road scenes, drives and training patches with exact ground truth.

A pinhole camera looks along a flat, straight road; vehicles are painted bodies in true perspective.
"""

from vehicle_detection.scenes.camera_light import SceneView
from vehicle_detection.scenes.drive import Drive, render_drive, truth_table
from vehicle_detection.scenes.render import VehicleTruth
from vehicle_detection.scenes.scene import Scene, SceneVehicle, render_patches, render_scene

__all__ = [
    "Drive",
    "Scene",
    "SceneVehicle",
    "SceneView",
    "VehicleTruth",
    "render_drive",
    "render_patches",
    "render_scene",
    "truth_table",
]
