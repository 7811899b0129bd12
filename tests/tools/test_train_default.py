import shutil

import numpy as np
import pytest

from tests.helpers import drawn, write_frame_set
from tools import train_default
from vehicle_detection.errors import DatasetError
from vehicle_detection.images import write_image
from vehicle_detection.mixture import load_model
from vehicle_detection.mixture_training import drawn_source
from vehicle_detection.training import detect_in_source, score_fold


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    for number, name in enumerate((*train_default.ROADS, "other")):
        write_frame_set(folder, name, drawn([number]))
    for number, name in enumerate(train_default.COURSE_SETS):
        write_frame_set(folder, name, drawn([number, number + 1]), place=".")
    return folder


def write_patches(folder, count):
    (folder / "vehicles" / "GTI_Far").mkdir(parents=True)
    for number in range(count):
        patch = np.full((64, 64, 3), number, np.uint8)
        write_image(folder / "vehicles" / "GTI_Far" / f"{number}.png", patch)


def test_sources_of_the_data_folder(data):
    found = train_default.load_sources(data)
    assert [source.name for source in found] == ["camvid", "dawn", "india", "indonesia", "course"]
    assert [[len(part) for part in source.sets] for source in found] == [[1], [1], [1], [1], [2, 2, 2]]
    assert [source.min_labelled_width for source in found] == [0.0, 0.0, 0.0, 60.0, 0.0]
    assert [part.name for part in found[-1].sets] == ["project_clip", "test_images", "test_video"]
    (data / "labels" / "india.csv").unlink()
    with pytest.raises(DatasetError, match=r"data lacks labels/india\.csv"):
        train_default.load_sources(data)


@pytest.mark.parametrize("zipped", [True, False], ids=["zip", "folder"])
def test_every_sixth_patch_is_loaded(tmp_path, zipped):
    assert train_default.load_vehicle_patches(tmp_path) == []
    write_patches(tmp_path, 25)
    if zipped:
        shutil.make_archive(str(tmp_path / "vehicles"), "zip", tmp_path, "vehicles")
        shutil.rmtree(tmp_path / "vehicles")
    found = train_default.load_vehicle_patches(tmp_path)
    assert [image.shape for image in found] == [(64, 64, 3)] * 5
    assert [image[0, 0, 0] for image in found] == [0, 6, 12, 18, 24]


def test_the_command_writes_model_card_curves_and_pictures(
    data, small_mixture, tmp_path, monkeypatch, capsys
):
    write_patches(data, 7)
    used = {}

    def cross_validate(sources, *, on_step, **options):
        """Stand in for the training: detect in the sources with a model that is already trained."""
        used.update(options, sources=sources)
        folds = [fold for source in sources for fold in detect_in_source(small_mixture, source)]
        on_step("trained")
        return small_mixture, [score_fold(fold, 0.0) for fold in folds], folds

    monkeypatch.setattr(train_default, "cross_validate_mixture", cross_validate)
    monkeypatch.setattr(
        train_default, "drawn_source", lambda **options: drawn_source(drives=1, frames=1, **options)
    )
    model, card, curves, pictures = (
        tmp_path / name for name in ("new.safetensors", "new.md", "new.csv", "pictures")
    )
    words = [data, "-o", model, "--card", card, "--curves", curves, "--pictures", pictures, "--seed", 5]
    train_default.main(list(map(str, words)))
    assert load_model(model).metadata["data"] == {
        "camvid": 1,
        "dawn": 1,
        "india": 1,
        "indonesia": 1,
        "course": 6,
        "drawn": 1,
        "patches": 2,
    }
    assert load_model(model).metadata["training"] == {"random_state": 5}
    assert [source.name for source in used["extra_sources"]] == ["drawn"]
    assert (len(used["patches"]), used["random_state"]) == (2, 5)
    assert "--seed 5" in card.read_text()
    assert "- 2 vehicles on the course's patches" in card.read_text()
    assert curves.read_text().startswith("frames,logit,precision,recall\ncamvid,")
    names = {path.name for path in pictures.iterdir()}
    assert {"curves.png", "india-missed.png", "test_video-false.png"} <= names
    assert len(names) == 15
    assert (pictures / "curves.png").read_bytes()[:4] == b"\x89PNG"
    out = capsys.readouterr().out
    assert out.startswith("trained\ncamvid: F1 ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{data}/none", "-o", "m.safetensors"], "none does not exist"),
        (["{data}", "-o", "{data}/none/m.safetensors"], "--output needs an existing folder"),
        (["{data}", "-o", "m.safetensors", "--card", "{data}"], "--card must be a file"),
        (["{data}", "-o", "m.safetensors", "--seed", "-1"], "random_state must be an integer"),
    ],
)
def test_bad_arguments_stop_before_the_training(data, monkeypatch, capsys, words, message):
    monkeypatch.setattr(train_default, "cross_validate_mixture", None)
    with pytest.raises(SystemExit):
        train_default.main([word.format(data=data) for word in words])
    assert message in capsys.readouterr().err
