"""Networks in ONNX files: the shipped one, and those of other detectors."""

from vehicle_detection.network.inputs import InputFormat, fit_input
from vehicle_detection.network.model import (
    FORMAT_VERSION,
    METADATA_KEY,
    VEHICLE_CLASSES,
    NetworkModel,
    load_network,
)
from vehicle_detection.network.outputs import Candidates, OutputFormat
from vehicle_detection.network.runtime import Device, GraphFacts, Session, open_session, read_facts
from vehicle_detection.network.search import NetworkSearch

__all__ = [
    "FORMAT_VERSION",
    "METADATA_KEY",
    "VEHICLE_CLASSES",
    "Candidates",
    "Device",
    "GraphFacts",
    "InputFormat",
    "NetworkModel",
    "NetworkSearch",
    "OutputFormat",
    "Session",
    "fit_input",
    "load_network",
    "open_session",
    "read_facts",
]
