import functools

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")
pytest.importorskip("onnx", reason="export needs onnx, the extra [train]")

from safetensors.torch import save_model

from tests.helpers import drawn, write_frame_set
from tests.training.networks import random_network
from tools import rides, train_default
from tools.rendered import rendered_source
from vehicle_detection.errors import DatasetError
from vehicle_detection.network import load_network
from vehicle_detection.training import NetworkTraining, export_network, set_metadata


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A data folder; the last two of three rides are kept out."""
    monkeypatch.setattr(rides, "_FIRST", 1)
    monkeypatch.setattr(train_default, "LEFT_OUT", ("dhaka", "india", "us_side"))
    folder = tmp_path / "data"
    write_frame_set(folder, "bdd", drawn(range(3)))
    for number, name in enumerate((*train_default.LEFT_OUT, "other")):
        write_frame_set(folder, name, drawn([number]))
    for number, name in enumerate(train_default.COURSE_SETS):
        write_frame_set(folder, name, drawn([number, number + 1]), place=".")
    return folder


def test_sources_of_the_data_folder(data):
    found = train_default.load_sources(data)
    assert [source.name for source in found] == ["bdd", *train_default.LEFT_OUT, "course"]
    assert [len(part) for part in found[-1].sets] == [2, 2, 2]
    bdd, course = train_default.load_sources(data, held_out=True)
    assert [part.keys for part in bdd.sets] == [("000.png",)]
    assert course.name == "course"
    (data / "labels" / "india.csv").unlink()
    with pytest.raises(DatasetError, match=r"data lacks labels/india\.csv"):
        train_default.load_sources(data)


@pytest.fixture(scope="module")
def exported():
    return export_network(random_network(), [], {}, {}, quantize=False)


@pytest.fixture
def quick(monkeypatch, exported):
    """Few rendered frames, small samples, and the file of one network, as exporting takes seconds."""
    small = functools.partial(NetworkTraining, batch=2, size=(96, 64), warm_up=1)
    monkeypatch.setattr(train_default, "NetworkTraining", small)
    monkeypatch.setattr(train_default, "rendered_source", functools.partial(rendered_source, frames=1))
    monkeypatch.setattr(
        train_default, "export_network", lambda network, frames, *facts: set_metadata(exported, *facts)
    )
    monkeypatch.setattr(train_default, "_INPUT_SIZE", 160)
    # The boxes of a network without training have no calibration.
    monkeypatch.setattr(train_default, "fit_log_odds", lambda folds: (2.0, 0.5))


def test_the_command_writes_model_card_curves_and_pictures(data, quick, tmp_path, capsys):
    names = "new.onnx", "new.md", "new.csv", "pictures", "w.safetensors"
    model, card, curves, pictures, weights = (tmp_path / name for name in names)
    save_model(random_network(), weights)
    words = [data, "-o", model, "--card", card, "--curves", curves, "--pictures", pictures, "--seed", 5]
    words += ["--weights", weights, "--held-out-weights", weights, "--trained-on", "a GPU", "--jobs", 1]
    train_default.main(list(map(str, words)))
    written = load_network(model)
    counts = {"bdd": 3, "course": 6, "rendered": 1} | dict.fromkeys(train_default.LEFT_OUT, 1)
    assert written.metadata["data"].items() > counts.items()
    assert written.metadata["training"].items() >= {"hardware": "a GPU", "random_state": 5}.items()
    assert list(written.metadata["metrics"]["left_out"]) == ["bdd", *train_default.LEFT_OUT]
    assert written.metadata["metrics"]["left_out"]["bdd"]["frames"] == 2
    assert np.isfinite([written.slope, written.offset, written.threshold]).all()
    assert "- Hardware and time: a GPU\n" in card.read_text()
    assert curves.read_text().startswith("frames,logit,precision,recall\n")
    assert (pictures / "dhaka-missed.png").exists()
    assert "us_side: F1 0." in capsys.readouterr().out


def test_the_network_for_the_measurements_is_trained_without_the_left_out_sources(data, quick, tmp_path):
    model, weights = tmp_path / "held.onnx", tmp_path / "held.safetensors"
    words = [data, "-o", model, "--held-out", "--steps", 1, "--jobs", 1, "--device", "cpu"]
    train_default.main(list(map(str, [*words, "--save-weights", weights])))
    facts = load_network(model).metadata
    assert facts["data"].items() >= {"bdd": 1, "course": 6, "rendered": 1}.items()
    assert "india" not in facts["data"]
    assert facts["training"]["steps"] == 1
    assert weights.exists()
    assert not list(tmp_path.glob("*.checkpoint"))


def test_bad_input_is_one_line(data, tmp_path, capsys):
    for words, message in (
        (["{data}", "-o", "{data}/none/m.onnx"], "--output needs an existing folder"),
        (["{data}/none", "-o", "{data}/m.onnx"], "does not exist"),
    ):
        with pytest.raises(SystemExit) as error:
            train_default.main([word.format(data=data) for word in words])
        assert error.value.code == 2
        assert message in capsys.readouterr().err
