import json
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np

from tests.cli.commands import contents, patches_of, refuse, refuse_each, succeed
from vehicle_detection import InvalidInputError, VehicleClassifier, load_classifier, load_model, write_image


def test_train_writes_model_report_and_card(material, tmp_path):
    with zipfile.ZipFile(tmp_path / "vehicles.zip", "w") as archive:
        for path in sorted((material / "vehicles").rglob("*.png")):
            archive.write(path, path.relative_to(material))
    patches = ["--vehicles", tmp_path / "vehicles.zip", "--non-vehicles", material / "non-vehicles"]
    model, report, card = (tmp_path / name for name in ("m.safetensors", "r.json", "c.md"))
    words = ["--features", "luv-2384", "--compare", "ycrcb-6156", "--split", "sequences", "--seed", 2]
    out = succeed("train", *patches, "-o", model, *words, "--report", report, "--card", card)
    assert "luv-2384: 20 vehicles, 20 others, accuracy" in out
    assert "GTI" not in out  # splits of the course's patches
    assert out.endswith(f"wrote {model}, {report}, {card}\n")
    written = json.loads(report.read_text())
    assert set(written["splits"]) == {"random", "sequences"}
    assert written["params"]["color_space"] == "LUV"
    assert written["others"][0]["features"] == "ycrcb-6156"
    assert {"features", "calibration", "random", "sequences", "leakage", "final"} == set(written["seconds"])
    text = card.read_text()
    assert (
        "vehicle-detection train --vehicles vehicles.zip --non-vehicles non-vehicles --features luv-2384 "
        "--split sequences --C 0.0001 --seed 2 --gamma 0.4 --degraded 0.05 --compare ycrcb-6156 "
        "-o m.safetensors --card c.md\n"
    ) in text
    assert str(tmp_path) not in text
    again = tmp_path / "again.safetensors"
    succeed("train", *patches_of(material), "-o", again, *words)
    assert again.read_bytes() == model.read_bytes()
    out = succeed("info", model)
    assert out.startswith(f"{model}: 2384 features, 1 template\n")
    for line in (r"color_space +LUV", r"C +0.0001", r"sources +drawn 40", r"last fifth of each folder +\d"):
        assert re.search(line, out), line
    assert load_classifier(model).metadata["training"]["random_state"] == 2


BAD_TRAINING = {
    "--vehicles none {others} {model}": "--vehicles none does not exist; check the path",
    "{vehicles} --non-vehicles {material}/empty {model}": "--non-vehicles .+empty holds no PNG or JPEG",
    "--vehicles small {others} {model}": "1.png of small is 32x32 pixels, expected 64x64",
    "--vehicles cut {others} {model}": "cut_road.png of cut must be a complete image file",
    "--vehicles small.zip {others} {model}": "small.zip is not a zip",
    "--vehicles one --non-vehicles one {model}": "--non-vehicles one is also --vehicles one;",
    "--vehicles one {others} {model}": "1 vehicles and 20 non-vehicles are too few",
    "{vehicles} {others} -o none/m.safetensors": "--output needs an existing folder",
    "--vehicles small.zip {others} -o small.zip": "--output small.zip is also --vehicles small.zip;",
    "{vehicles} {others} {model} --report m.safetensors": "--report .+ is also --output .+;",
    "{vehicles} {others} {model} --card none/card.md": "--card needs an existing folder",
}


def test_train_refuses_bad_input_and_writes_nothing(material, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("small", "cut", "one"):
        Path(name).mkdir()
    write_image("small/1.png", np.zeros((32, 32, 3), np.uint8))
    shutil.copy(material / "cut_road.png", "cut")
    patch = material / "vehicles" / "drawn" / "0.png"
    shutil.copy(patch, "small.zip")
    shutil.copy(patch, "one")
    before, original = contents(tmp_path), Path("small.zip").read_bytes()
    vehicles, others = (f"--{name} {material / name}" for name in ("vehicles", "non-vehicles"))
    files = {"vehicles": vehicles, "others": others, "model": "-o m.safetensors", "material": material}
    refuse_each("train", BAD_TRAINING, **files)
    assert contents(tmp_path) == before
    assert Path("small.zip").read_bytes() == original


def test_defaults_are_those_of_the_library(monkeypatch, material, tmp_path):
    given = {}

    def note(patches, **options):
        given.update(options)
        raise InvalidInputError("enough")

    monkeypatch.setattr("vehicle_detection.train_and_evaluate", note)
    refuse("train", *patches_of(material), "-o", tmp_path / "m.safetensors")
    assert given["params"] == load_classifier().params
    assert given["split"] == "random"
    recipe = load_classifier().metadata["training"]
    for name in ("C", "gamma", "degraded", "mirror", "random_state"):
        assert getattr(given["options"], name) == recipe[name], name


def test_fetch_prints_the_paths_of_the_patches(monkeypatch, tmp_path):
    names = "vehicles.zip", "non-vehicles.zip"
    monkeypatch.setattr(
        "vehicle_detection.fetch_patches", lambda output, progress: [output / name for name in names]
    )
    assert succeed("fetch", "-o", tmp_path).splitlines() == [str(tmp_path / name) for name in names]


def test_info_of_the_shipped_models():
    out = succeed("info", "highway")
    model = load_classifier()
    assert out.startswith(f"highway: {model.params.length} features, 1 template\n")
    assert re.search(rf"color_space +{model.params.color_space}\s", out)
    assert re.search(r"numpy +\d", out)
    split = model.metadata["metrics"]["splits"]["sequences"]
    rates = f"{split['false_negative_rate']:.2%} +{split['false_positive_rate']:.2%}"
    assert re.search(rf"last fifth of each folder +3,553 +{split['accuracy']:.4f} +{rates} +", out)
    out = succeed("info", "default")
    assert succeed("info") == out
    default = load_model()
    assert re.match(r"default: network, threshold at a probability of 0\.\d+\n", out)
    assert re.search(r"input +640 px\n", out)
    assert re.search(r"file +\d\.\d MB\n", out)
    for name, scores in default.metadata["metrics"]["left_out"].items():
        assert re.search(rf"{name} .*{scores['f1']:.3f}", out)


def test_info_of_a_model_with_incomplete_scores(tmp_path):
    model, path = load_classifier(), tmp_path / "m.safetensors"

    def info(metrics):
        VehicleClassifier(model.params, model.templates, {"metrics": metrics}).save(path)
        return succeed("info", path)

    assert re.search(r"road\W+0\.250", info({"left_out": {"road": {"f1": 0.25}}}))
    scores = info({"splits": {"random": {"accuracy": 0.5, "test": "x"}}})
    assert re.search(r"accuracy\s+─+\s+random fifth +0\.5000", scores)
    assert "random fifth" in info({"splits": {"random": {"accuracy": 10**400}}})
    held_out = {"held_out": {"a": {"f1": "x"}}, "held_out_before": 1}
    for odd in ({"splits": {"random": 3}}, {"left_out": {"a": [1]}}, held_out):
        assert "9432 features" in info(odd)
