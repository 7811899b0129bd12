"""Networks that were never trained."""

import functools

import torch

from vehicle_detection.training import export_network, fine_tune, network
from vehicle_detection.training.architecture import Network


def random_network(seed=0):
    """Random weights, with statistics and factors that are not those of the start of a training."""
    torch.manual_seed(seed)
    made = Network()
    with torch.no_grad():
        made.scale.copy_(torch.tensor([1.1, 0.9, 1.2, 0.8]))
        for name, value in made.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                value.add_(torch.rand_like(value) * 0.3)
    return made.eval()


def write_initial(path):
    """Write a network that was never trained, whose boxes all count."""
    params = {"input_size": 160, "slope": 1.0, "offset": 0.0, "threshold": -9.0, "nms_iou": 0.6}
    path.write_bytes(export_network(random_network(), [], params, {}, quantize=False))
    return path


def shrink_samples(monkeypatch):
    """Train on few small samples, report each step, and export in a fifth of the time."""
    monkeypatch.setattr(fine_tune, "_SIZE", (96, 64))
    monkeypatch.setattr(fine_tune, "_BATCH", 2)
    monkeypatch.setattr(fine_tune, "export_network", functools.partial(export_network, quantize=False))
    monkeypatch.setattr(network, "_REPORT_SECONDS", 0)
    monkeypatch.setattr(network, "_CHECKPOINT_SECONDS", 0)
