"""Networks in ONNX files: the shipped one, and those of other detectors."""

from vehicle_detection.network.loading import FORMAT_VERSION, METADATA_KEY, load_network
from vehicle_detection.network.model import NetworkModel, NetworkParams, NetworkSearch
from vehicle_detection.network.runtime import Device, GraphFacts, Session, open_session, read_facts
from vehicle_detection.network.tensors import Candidates, InputFormat, OutputFormat, fit_input

__all__ = [
    "FORMAT_VERSION",
    "METADATA_KEY",
    "Candidates",
    "Device",
    "GraphFacts",
    "InputFormat",
    "NetworkModel",
    "NetworkParams",
    "NetworkSearch",
    "OutputFormat",
    "Session",
    "fit_input",
    "load_network",
    "open_session",
    "read_facts",
]
