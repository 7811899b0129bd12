import re
import sys

import pytest

from tests.cli.commands import refuse, run
from tests.helpers import drawn, write_frame_set
from vehicle_detection import training


@pytest.fixture(scope="module")
def roads(tmp_path_factory):
    folder = tmp_path_factory.mktemp("roads")
    write_frame_set(folder, "town", drawn(range(4)))
    write_frame_set(folder, "coast", drawn(range(4, 6)))
    return folder


def test_without_pytorch_the_command_names_the_extra(roads, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    for name in "fine_tune", "export", "architecture", "network", "loss", "weights":
        monkeypatch.delitem(sys.modules, f"vehicle_detection.training.{name}", raising=False)
    monkeypatch.delitem(vars(training), "fine_tune_network", raising=False)
    message = refuse("train-frames", roads, "-o", tmp_path / "own.onnx")
    assert "needs the package torch, which is not installed" in message
    assert 'pip install "vehicle-detection[train]"' in message


@pytest.fixture
def initial(tmp_path, monkeypatch):
    """A network that was never trained; trainings of it have small samples."""
    pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")
    pytest.importorskip("onnx", reason="export needs onnx, the extra [train]")
    from tests.training.networks import shrink_samples, write_initial

    shrink_samples(monkeypatch)
    return write_initial(tmp_path / "initial.onnx")


def test_train_continue_and_show(roads, initial, tmp_path, monkeypatch):
    from vehicle_detection.training import fine_tune

    own, curves, checkpoint = (tmp_path / name for name in ("own.onnx", "c.csv", "own.onnx.checkpoint"))
    words = ["train-frames", roads, "-o", own, "--model", initial, "--steps", 2]
    words += ["--jobs", 1, "--device", "cpu", "--curves", curves]
    with monkeypatch.context() as patch:

        def interrupt(*arguments, **options):
            raise KeyboardInterrupt

        patch.setattr(fine_tune, "export_network", interrupt)
        result = run(*words)
    assert result.exit_code == 130
    assert result.stderr == f"interrupted; the same command continues from {checkpoint}\n"
    assert not own.exists()

    result = run(*words)
    assert result.exit_code == 0, result.output
    assert f"continuing the training of {checkpoint}\n" in result.stdout
    assert re.search(r"town: 4 frames, \d+ boxes, 0 frames without any\n", result.stdout)
    assert "on the frames held out of training, IoU 0.5" in result.stdout
    assert result.stdout.endswith(f"wrote {own}, {curves}\n")
    assert curves.read_text().startswith("frames,logit,precision,recall\n")
    assert not checkpoint.exists()

    shown = run("info", own).stdout
    for line in r"town, before +\d\.\d{3} ", r"town +\d\.\d{3} ", r"held_out +1\n", r"steps +2\n":
        assert re.search(line, shown), line
