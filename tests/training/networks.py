"""Networks that were never trained."""

import torch

from vehicle_detection.training.architecture import Network


def random_network(seed=0):
    """Random weights, with statistics and factors that are not those of the start of a training."""
    torch.manual_seed(seed)
    network = Network()
    with torch.no_grad():
        network.scale.copy_(torch.tensor([1.1, 0.9, 1.2, 0.8]))
        for name, value in network.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                value.add_(torch.rand_like(value) * 0.3)
    return network.eval()
