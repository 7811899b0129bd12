import numpy as np
import pytest

from tests.drawing.cases import blank, track
from vehicle_detection.annotator import draw_diagnostics
from vehicle_detection.boxes import Detections
from vehicle_detection.drawing import (
    TRACK_COLORS,
    draw_cell_shares,
)
from vehicle_detection.errors import InvalidInputError


class TestDiagnostics:
    @pytest.mark.parametrize(("height", "width"), [(720, 1280), (361, 481), (1920, 1080), (4, 5)])
    def test_has_the_shape_of_the_frame(self, height, width):
        heat = np.zeros((height, width), np.float32)
        mosaic = draw_diagnostics(blank(height, width), np.empty((0, 4)), heat, [])
        assert mosaic.shape == (height, width, 3)
        assert mosaic.dtype == np.uint8

    def test_shows_frame_windows_heat_and_tracks(self):
        frame, heat = blank(), np.zeros((720, 1280))
        heat[400:490, 600:700] = 7
        before = frame.copy()
        mosaic = draw_diagnostics(frame, Detections([[600, 400, 700, 490]], [1.0]), heat, [track()])
        np.testing.assert_array_equal(frame, before)
        panels = mosaic[:360, :640], mosaic[:360, 640:], mosaic[360:, :640], mosaic[360:, 640:]
        inside = [panel[200:245, 300:350] for panel in panels]
        assert (inside[0] == 90).all()
        assert (inside[1][0, 0] != 90).any()
        assert inside[2][20, 20].sum() > 500
        assert panels[2][300, 500].sum() < 20
        assert (inside[3][-1, 25] == TRACK_COLORS[0]).all()

    def test_frames_need_not_be_in_c_order(self):
        image, heat = np.random.default_rng(0).integers(0, 256, (60, 90, 3), np.uint8), np.zeros((60, 90))
        expected = draw_diagnostics(image, [[5, 5, 30, 30]], heat, [])
        for frame in (np.asfortranarray(image), image[:, ::-1][:, ::-1]):
            np.testing.assert_array_equal(draw_diagnostics(frame, [[5, 5, 30, 30]], heat, []), expected)

    def test_heat_may_be_smaller_empty_boolean_or_of_integers(self):
        for heat in (np.zeros((90, 160)), np.ones((90, 160), int), np.ones((9, 16), bool), -np.ones((9, 16))):
            assert draw_diagnostics(blank(), [], heat, []).shape == (720, 1280, 3)

    def test_rejects_malformed_arguments(self):
        heat = np.zeros((720, 1280))
        with pytest.raises(InvalidInputError, match=r"frame must be an \(H, W, 3\)"):
            draw_diagnostics(heat, [], heat, [])
        with pytest.raises(InvalidInputError, match="frame must be at least 4x4 pixels"):
            draw_diagnostics(blank(3, 9), [], heat, [])
        with pytest.raises(InvalidInputError, match=r"heat must be an \(h, w\) array of numbers"):
            draw_diagnostics(blank(), [], blank(), [])
        with pytest.raises(InvalidInputError, match="heat must be finite"):
            draw_diagnostics(blank(), [], np.full((9, 16), np.nan), [])


def test_shares_of_cells_are_drawn_by_sign_and_amount():
    image = np.full((40, 60, 3), 90, np.uint8)
    drawn = draw_cell_shares(image, [10, 10, 50, 30], np.array([[1.0, -1.0], [0.5, 0.0]]))
    assert (image == 90).all()
    orange, blue, weak, none = drawn[12, 15], drawn[12, 45], drawn[28, 15], drawn[28, 45]
    assert orange[0] > orange[2]
    assert blue[2] > blue[0]
    assert 90 < weak[0] < orange[0]
    assert (none == 90).all()
    outside = draw_cell_shares(image, [-20, -20, 200, 100], np.zeros((3, 3)))
    np.testing.assert_array_equal(outside, image)
