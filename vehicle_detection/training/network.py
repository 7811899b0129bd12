"""Train the network on labelled frames, from random weights or from those of another network."""

from __future__ import annotations

import contextlib
import copy
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from vehicle_detection._common import atomic_write, resolve_jobs
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.training.architecture import Network, cell_centers
from vehicle_detection.training.frames import TrainingFrame
from vehicle_detection.training.loss import Targets, detection_loss
from vehicle_detection.training.samples import Sampler

log = logging.getLogger(__name__)

_LAST_RATE = 0.02  # as a fraction of the highest
_WEIGHT_DECAY = 0.05  # of kernels
_MAX_GRADIENT = 5.0  # norm
_CHECKPOINT_SECONDS, _REPORT_SECONDS = 30.0, 10.0


@dataclass(frozen=True, kw_only=True)
class NetworkTraining:
    """Length and course of a training."""

    steps: int
    batch: int = 64  # samples of a step
    size: tuple[int, int] = (640, 384)  # width and height of the samples (px), multiples of 32
    rate: float = 2.5e-3  # highest learning rate of AdamW, after `warm_up` steps; it falls as a cosine
    random_state: int = 0  # seed of the samples and of the first weights
    warm_up: int = 300  # steps over which the rate rises
    # Keep means and variances of batch normalization: for small batches and networks of `read_weights`.
    frozen_statistics: bool = False
    data: str = ""  # fingerprint of frames and initial weights; a checkpoint with another is not continued


def train_network(
    frames: Sequence[TrainingFrame],
    training: NetworkTraining,
    *,
    initial: Network | None = None,
    device: str | None = None,
    jobs: int | None = None,
    checkpoint: Path | None = None,
    on_step: Callable[[int, str], object] | None = None,
) -> Network:
    """Train a network on frames in memory, from `initial` or from random weights.

    `jobs` threads compute on the processor. An interrupted training continues from its `checkpoint`.
    `on_step` is called with the number of finished steps and a line of text, now and then. Returns the moving
    average of the weights, on the processor, for evaluation.
    """
    if not any(len(frame.boxes) for frame in frames):
        raise InvalidInputError("frames must show at least one vehicle; label some, and pass their labels")
    if any(side < 32 or side % 32 for side in training.size):
        raise InvalidInputError(
            f"size must be multiples of 32, got {training.size}; choose (640, 384), for example"
        )
    place = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    jobs = resolve_jobs(jobs)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.random_state)
        network = copy.deepcopy(initial) if initial is not None else Network()
    state = _State(network.to(place), training)
    if checkpoint is not None and checkpoint.exists():
        state.load(checkpoint)
    report = on_step or (lambda _, line: log.info(line))
    centers, _ = cell_centers(training.size[1], training.size[0], place)
    sampler = Sampler(frames, training.size, place)
    first, start = state.step, time.monotonic()
    reported = saved = start
    cudnn = torch.backends.cudnn
    with contextlib.ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(jobs)
        # On CUDA, algorithms that add in the same order each time.
        stack.callback(setattr, cudnn, "deterministic", cudnn.deterministic)
        cudnn.deterministic = True
        while state.step < training.steps:
            images, targets = sampler.draw(
                np.random.default_rng([training.random_state, state.step]), training.batch
            )
            losses = state.update(images, targets, centers)
            now = time.monotonic()
            if now - reported >= _REPORT_SECONDS or state.step == training.steps:
                reported = now
                score, box = (each.item() for each in losses)
                passed = now - start
                left = passed / (state.step - first) * (training.steps - state.step)
                times = f"{_minutes(passed)} min, {_minutes(left)} min left"
                progress = f"step {state.step} of {training.steps}"
                report(state.step, f"{progress}: {times}, losses {score:.3f} + {box:.3f}")
            if checkpoint is not None and now - saved >= _CHECKPOINT_SECONDS:
                saved = now
                state.save(checkpoint)
    average: Network = state.average.cpu().eval()
    return average


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


class _State:
    """What changes during a training: weights, their moving average, optimizer, number of steps."""

    def __init__(self, network: Network, training: NetworkTraining) -> None:
        self.step, self.training = 0, training
        self.average = copy.deepcopy(network).eval()
        self.network = network.to(memory_format=torch.channels_last).train()
        self.models = nn.ModuleDict({"network": self.network, "average": self.average})
        if training.frozen_statistics:
            for module in network.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        kernels = [each for each in network.parameters() if each.ndim > 1]
        others = [each for each in network.parameters() if each.ndim <= 1]
        groups = [{"params": kernels, "weight_decay": _WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=training.rate, fused=True)

    def update(self, images: Tensor, targets: Targets, centers: Tensor) -> tuple[Tensor, Tensor]:
        """Take one step; return its losses."""
        progress = self.step / self.training.steps
        cosine = _LAST_RATE + (1 - _LAST_RATE) * (1 + math.cos(math.pi * progress)) / 2
        for group in self.optimizer.param_groups:
            group["lr"] = self.training.rate * min(1.0, (self.step + 1) / self.training.warm_up) * cosine
        with torch.autocast(images.device.type, torch.bfloat16, enabled=_multiplies_bfloat16(images.device)):
            logits, boxes = self.network(images)
        losses = detection_loss(logits, boxes, centers, targets)
        self.optimizer.zero_grad()
        sum(losses).backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), _MAX_GRADIENT)
        self.optimizer.step()
        self.step += 1
        decay = (1 + self.step) / (20 + self.step)  # the average covers the last twentieth of the steps
        means, values = (list(each.state_dict().values()) for each in (self.average, self.network))
        floats = [row for row, mean in enumerate(means) if mean.dtype.is_floating_point]
        torch._foreach_lerp_([means[i] for i in floats], [values[i] for i in floats], 1 - decay)
        return losses

    def save(self, path: Path) -> None:
        """Write the state as a safetensors file."""
        from safetensors.torch import save

        tensors = self.models.state_dict()
        for number, values in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{number}.{name}": value for name, value in values.items()}
        plain = {name: value.contiguous() for name, value in tensors.items()}
        with atomic_write(path, "checkpoint") as part:
            part.write_bytes(save(plain, {"step": str(self.step), "training": repr(self.training)}))

    def load(self, path: Path) -> None:
        """Continue from a file of `save`."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, "pt") as file:
                facts = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except SafetensorError as error:
            raise InvalidInputError(
                f"checkpoint {path} is not a complete file of a training ({error}); remove it"
            ) from error
        if facts.get("training") != repr(self.training):
            raise InvalidInputError(
                f"checkpoint {path} is of an interrupted training with other frames or options; repeat "
                "those, or remove it to start again"
            )
        self.models.load_state_dict({name: tensors[name] for name in self.models.state_dict()})
        parameters = [each for group in self.optimizer.param_groups for each in group["params"]]
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            if name.startswith("optimizer."):
                _, number, key = name.split(".")
                if key != "step":  # the fused optimizer needs the memory layout of the parameter
                    value = torch.empty_like(parameters[int(number)]).copy_(value)
                state.setdefault(int(number), {})[key] = value
        self.optimizer.load_state_dict(self.optimizer.state_dict() | {"state": state})
        self.step = int(facts["step"])


def _multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device is faster with bfloat16 than with float32."""
    tests = (getattr(torch.cpu, f"_is_{name}_supported", bool) for name in ("amx_tile", "avx512_bf16"))
    return device.type == "cuda" or any(test() for test in tests)
