import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")

from tests.helpers import drawn  # noqa: E402
from vehicle_detection.errors import InvalidInputError  # noqa: E402
from vehicle_detection.training import FrameDataset, NetworkTraining, load_training_frames, train_network  # noqa: E402
from vehicle_detection.training import network as module  # noqa: E402

TRAINING = NetworkTraining(steps=4, batch=2, size=(96, 64), warm_up=2)


@pytest.fixture(scope="module")
def frames():
    return load_training_frames([FrameDataset("road", (drawn(range(3)),))], max_side=160)


@pytest.fixture(autouse=True)
def report_each_step(monkeypatch):
    monkeypatch.setattr(module, "_REPORT_SECONDS", 0)
    monkeypatch.setattr(module, "_CHECKPOINT_SECONDS", 0)


def train(frames, training=TRAINING, **options):
    return train_network(frames, training, device="cpu", jobs=1, **options).state_dict()


class StopError(Exception):
    pass


def test_a_resumed_training_equals_an_uninterrupted_one(frames, tmp_path):
    steps, checkpoint = [], tmp_path / "state"

    def interrupt(step, line):
        steps.append(step)
        if len(steps) == 3:
            raise StopError

    with pytest.raises(StopError):
        train(frames, checkpoint=checkpoint, on_step=interrupt)
    resumed = train(frames, checkpoint=checkpoint, on_step=interrupt)
    assert steps == [1, 2, 3, 3, 4]  # the third step was interrupted before its checkpoint
    for name, value in train(frames).items():
        assert torch.equal(value, resumed[name]), name


def test_the_global_generator_stays_as_it_is(frames):
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    train(frames, dataclasses.replace(TRAINING, steps=1))
    assert torch.equal(torch.rand(3), expected)


def test_frozen_statistics_stay_as_they_are(frames):
    initial = module.Network()
    frozen = dataclasses.replace(TRAINING, steps=2, frozen_statistics=True)
    state = train(frames, frozen, initial=initial)
    for name, value in initial.state_dict().items():
        assert torch.equal(state[name], value) == ("running" in name or "num_batches" in name), name


def test_progress_names_steps_times_and_losses(frames):
    lines = []
    train(frames, on_step=lambda step, line: lines.append((step, line)))
    assert [step for step, _ in lines] == [1, 2, 3, 4]
    assert lines[-1][1].startswith("step 4 of 4: 0:")
    assert "0:00 min left, losses " in lines[-1][1]


def test_checkpoints_of_other_trainings_and_damaged_ones_are_refused(frames, tmp_path):
    checkpoint = tmp_path / "state"
    train(frames, dataclasses.replace(TRAINING, steps=1), checkpoint=checkpoint)
    with pytest.raises(InvalidInputError, match="of an interrupted training with other frames or options"):
        train(frames, checkpoint=checkpoint)
    checkpoint.write_bytes(checkpoint.read_bytes()[:2000])
    with pytest.raises(InvalidInputError, match=r"is not a complete file of a training .+; remove it"):
        train(frames, checkpoint=checkpoint)


def test_frames_without_vehicles_are_refused(frames):
    empty = [dataclasses.replace(frame, boxes=np.zeros((0, 4))) for frame in frames]
    with pytest.raises(InvalidInputError, match="frames must show at least one vehicle; label some"):
        train(empty)


@pytest.mark.parametrize("size", [(100, 64), (64, 0)])
def test_sizes_that_are_no_multiples_of_32_are_refused(frames, size):
    with pytest.raises(InvalidInputError, match=r"size must be multiples of 32, .+; choose \(640, 384\)"):
        train(frames, dataclasses.replace(TRAINING, size=size))
