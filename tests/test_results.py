import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from PIL import Image, ImageShow

from tests.helpers import answer, serve
from vehicle_detection import (
    Detections,
    Detector,
    TrackTable,
    detect,
    detector_from,
    read_labels,
    track,
    write_tracks,
)
from vehicle_detection.boxes import clip_boxes
from vehicle_detection.camera import Camera
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.images import read_image, write_image
from vehicle_detection.results import image_distances
from vehicle_detection.scenes import render_drive

ROAD, OTHER = "test_images/road1.jpg", "test_images/road2.jpg"


@pytest.fixture(scope="module")
def detector():
    return Detector("highway")


@pytest.fixture(scope="module")
def expected(detector):
    return detector.detect(read_image(ROAD)), detector.detect(read_image(OTHER))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "below").mkdir()
    shutil.copy(ROAD, tmp_path / "a2.jpg")
    shutil.copy(OTHER, tmp_path / "below" / "a10.jpg")
    for name in (".hidden.jpg", "notes.txt"):
        (tmp_path / name).write_text("no image")
    return tmp_path


def test_an_image_may_be_an_array_a_file_bytes_or_of_pillow(detector, expected):
    with open(ROAD, "rb") as file:
        data = file.read()
    for image in (ROAD, data, Image.open(ROAD)):
        np.testing.assert_array_equal(detector.detect(image).boxes, expected[0].boxes)


def test_an_image_of_pillow_is_converted_and_turned(detector, expected):
    turned = Image.open(ROAD).rotate(90, expand=True)
    turned.getexif()[0x0112] = 6
    assert detector.detect(turned).image.shape == (720, 1280, 3)
    assert detector.detect(Image.open(ROAD).convert("RGBA")).boxes.tolist() == expected[0].boxes.tolist()


def test_several_images_give_a_list(detector, expected, folder):
    for images in ([ROAD, read_image(OTHER)], folder, str(folder / "**" / "*.jpg")):
        found = detector.detect(images)
        assert [len(each) for each in found] == [len(each) for each in expected]
        for one, other in zip(found, expected):
            np.testing.assert_array_equal(one.boxes, other.boxes)
    assert [each.path.name for each in detector.detect(folder)] == ["a2.jpg", "a10.jpg"]
    assert detector.detect([]) == []


def test_a_url_is_downloaded(detector, expected, folder):
    def handle(request):
        file = folder / request.path[1:]
        answer(request, *((200, file.read_bytes()) if file.exists() else (404,)))

    with serve(handle) as address:
        found = detector.detect(f"{address}/a2.jpg")
        assert found.boxes.tolist() == expected[0].boxes.tolist()
        assert found.path is None
        with pytest.raises(InvalidInputError, match=r"URL .*nothing.jpg does not exist; check the address"):
            detector.detect(f"{address}/nothing.jpg")


def test_what_is_no_image_is_refused(detector, tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(16))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for image, message in (
        (tmp_path / "a.heic", "is HEIC, .*pip install pillow-heif"),
        (str(tmp_path / "*.jpg"), "holds no image file"),
        ([ROAD, None], "image must be"),
        (b"x", "the bytes must be a complete image"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            detector.detect(image)


def test_the_confidence_of_a_call_is_that_of_a_detector_with_it():
    for model in ("default", "highway"):
        with Detector(model, conf=0.7) as general:
            for conf in (0.1, 0.95):
                found, wanted = general.detect(ROAD, conf=conf), Detector(model, conf=conf).detect(ROAD)
                np.testing.assert_array_equal(found.boxes, wanted.boxes)
                np.testing.assert_allclose(found.scores, wanted.scores)
                assert (found.confidences >= conf).all()
            assert len(general.detect(ROAD, conf=0.001)) >= len(general.detect(ROAD))


def test_one_line_detects_and_keeps_the_model(expected):
    found = detect(ROAD, "highway")
    assert found.boxes.tolist() == expected[0].boxes.tolist()
    assert len(detect([ROAD, OTHER], "highway")) == 2
    with VehicleDetector("highway") as detector:
        assert len(detector.detect(ROAD, conf=0.9)) == len(detect(ROAD, "highway", conf=0.9))


def test_the_picture_is_returned_written_and_shown(detector, tmp_path, monkeypatch):
    found = detector.detect(ROAD)
    picture = found.plot(scores=False)
    changed = (picture != found.image).any(axis=2)
    x1, y1, x2, _ = found.boxes[0].round().astype(int)
    assert changed[y1, x1:x2].all()
    found.save(tmp_path / "out.png", scores=False)
    np.testing.assert_array_equal(read_image(tmp_path / "out.png"), picture)
    shown = []
    monkeypatch.setattr(ImageShow, "show", lambda image, title: shown.append(image.size) or True)
    found[:1].show()
    assert shown == [(1280, 720)]
    monkeypatch.setattr(ImageShow, "show", lambda image, title: False)
    with pytest.raises(InvalidInputError, match="use save"):
        found.show()
    monkeypatch.setitem(
        sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=1))
    )
    display = SimpleNamespace(display=lambda picture: shown.append(picture.size))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    found.show()
    assert len(shown) == 2


def test_distances_need_a_camera(detector):
    found = detector.detect(ROAD)
    near, far = (found.distances(Camera.dashcam(fov=fov, horizon=0.55)) for fov in (90, 45))
    assert near.shape == (2, len(found))
    assert (far[0] > 1.5 * near[0]).all()
    assert (near[1] > 0).all()


def test_a_known_lens_gives_distances_without_a_horizon(detector, expected):
    camera = Camera.dashcam(fov=60)
    with Detector("highway", camera=camera) as measuring:
        found = measuring.detect(ROAD)
    true = expected[0].distances(Camera.dashcam(fov=60, horizon=0.55))[0]
    assert (np.abs(found.distances_m - true) < 2 * found.distance_stds_m).all()
    np.testing.assert_array_equal(found[1:].to_pandas()["distance_m"], found.distances_m[1:])
    assert TrackTable.from_detections([found])["distance_std_m"].tolist() == found.distance_stds_m.tolist()
    assert expected[0].distances_m is None
    assert "distance_m" not in expected[0].to_pandas()


@pytest.mark.parametrize("lens", [{"fov": 60}, {"lens": "fisheye-140"}])
def test_distances_depend_on_neither_scores_nor_other_boxes(lens):
    camera = Camera.for_frame((720, 1280), horizon=0.5, **lens)
    boxes = np.array([[600, 380, 700, 450], [650, 390, 720, 440], [0, 380, 300, 700], [9, 9, 9, 9]])
    together = image_distances(Detections(boxes, [3.0, -1.0, 0.5, 1.0]), (720, 1280), camera)
    alone = [image_distances(Detections(box[None], [2.0]), (720, 1280), camera)[:, 0] for box in boxes]
    np.testing.assert_allclose(together, np.transpose(alone), rtol=1e-12)
    assert np.isfinite(together).all(axis=0).tolist() == [True, True, True, False]


def test_stated_errors_of_images_hold_without_a_horizon():
    """Near and far vehicles of rendered drives, whose boxes have the errors of a detector."""
    errors, stated = [], []
    rng = np.random.default_rng(0)
    for seed, scenario in enumerate(("traffic", "passing", "occlusion")):
        options = {"frames": 4, "fps": 1.25, "rough": True, "focal_px": 900.0}
        labels = render_drive(**options, scenario=scenario, random_state=seed).labels
        for number in range(4):
            truth = labels.frame(number)
            truth = truth[~truth["ignore"]]
            sides = np.tile(truth.boxes[:, 2:] - truth.boxes[:, :2], 2)
            boxes = clip_boxes(truth.boxes + 0.03 * sides * rng.normal(size=sides.shape), (720, 1280))
            found = Detections(boxes, np.full(len(boxes), 3.0))
            camera = Camera.dashcam(fov=np.degrees(2 * np.arctan(640 / 900)))
            distance, std = image_distances(found, (720, 1280), camera)
            stated += np.isfinite(distance).tolist()
            errors += (np.abs(distance - truth["distance_m"]) / std)[np.isfinite(distance)].tolist()
    assert np.mean(stated) > 0.9
    assert 0.9 < np.mean(np.array(errors) < 2) <= 1


def test_files_are_read_again_for_the_picture(detector, tmp_path):
    write_image(tmp_path / "road.png", read_image(ROAD))
    found = detector.detect(tmp_path / "road.png")
    (tmp_path / "road.png").unlink()
    with pytest.raises(InvalidInputError, match="does not exist"):
        found.plot()


def test_tables_name_the_files_of_a_list(detector, expected, folder):
    table = TrackTable.from_detections(detector.detect(folder))
    assert table.frame_keys == ("a2.jpg", "a10.jpg")
    assert len(table) == sum(map(len, expected))
    assert TrackTable.from_detections([*expected]).frame_keys == (0, 1)


def test_tracks_have_the_class_of_most_detections(tmp_path):
    def find(image):
        kind = "truck" if image[0, 0, 0] % 3 else "car"
        return Detections([[100, 60, 160, 100]], [0.9], labels=[kind], class_ids=[7])

    frames = [np.full((180, 320, 3), number, np.uint8) for number in range(1, 21)]
    own = detector_from(lambda image: find(image).with_columns(scores=np.array([0.9])))
    results = [own.process(frame, time=number / 10) for number, frame in enumerate(frames)]
    assert {track.label for track in results[-1].shown} == {"truck"}
    assert results[-1].to_pandas()["label"].tolist() == ["truck"]
    assert results[-1].shown[0].name == "truck #1"
    for name in ("t.csv", "t.jsonl", "t.parquet"):
        write_tracks(results, tmp_path / name)
        assert set(read_labels(tmp_path / name)["label"]) == {"truck"}


def test_a_video_becomes_a_table_at_once_or_frame_by_frame():
    source, options = "test_images/road*.jpg", {"every": 1, "end": 0.16}
    whole = track(source, "highway", **options).to_pandas()
    assert {"frame", "track_id", "x1", "confidence", "label", "time_s"} <= {*whole}
    with track(source, "highway", **options) as run:
        parts = pd.concat([result.to_pandas() for result in run], ignore_index=True)
    pd.testing.assert_frame_equal(whole, parts)
