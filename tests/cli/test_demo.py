import re
from dataclasses import replace

from tests.cli.commands import contents, succeed
from vehicle_detection import probe_video, read_image, render_drive
from vehicle_detection.cli.demo import FILES, REPORT, SHEET, scored_truth


def test_demo_draws_annotates_and_scores(tmp_path):
    folder, files = tmp_path / "shown", [*FILES, REPORT]
    out = succeed("demo", "-o", folder, "--frames", 3, "--seed", 4, "--report")
    assert out.startswith("3 rendered frames of 1280x720")
    for name in ("F1", "mean IoU", "MOTA", "identity switches"):
        assert re.search(rf"^  {name} +(-?\d\S*|nan)\s*$", out, re.MULTILINE), out
    assert re.search(r"speed +\d+\.\d frames/s on this machine, \d+\.\d times real time", out)
    assert re.search(r"boxes +\d+ on a vehicle, \d+ missed, \d+ false", out)
    assert out.splitlines()[-1] == f"wrote {', '.join(files)} in {folder}"
    assert contents(folder) == sorted(files)
    for name in ("clip.mp4", "annotated.mp4"):
        info = probe_video(folder / name)
        assert (info.shape, info.frames, float(info.fps)) == ((720, 1280, 3), 3, 25.0)
    assert read_image(folder / "contact_sheet.png").shape == (SHEET[0] * 360, SHEET[1] * 640, 3)
    assert "Detections in" in succeed("evaluate", folder / "tracks.csv", folder / "labels.csv")
    assert "data:video/mp4;base64," in (folder / REPORT).read_text(encoding="utf-8")


def test_demo_scores_oncoming_vehicles():
    drive = render_drive(frames=120, shape=(360, 640))
    rows = [row for frame in range(0, 120, 12) for row in drive.truth_of(frame)]
    for row, scored in zip(rows, scored_truth(rows), strict=True):
        assert scored == replace(row, ignore=row.hard_to_see)
        assert row.ignore == (row.hard_to_see or row.speed_mps < -40)
    assert any(row.ignore and not row.hard_to_see for row in rows)
