import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehicle_detection import FunctionParams, InvalidInputError, NetworkParams, RegionParams, TrackParams
from vehicle_detection.features import FeatureParams, extract_features, single_img_features
from vehicle_detection.heatmap import HeatParams, heat_range
from vehicle_detection.search import PixelBand, SearchBand, SearchParams
from vehicle_detection.windows import band_windows

PARTS = ("spatial_feat", "hist_feat", "hog_feat")
BAND = SearchBand(window=(64, 64), y=(0, 256))
SEARCH = SearchParams(bands=(BAND,), horizon=0.5)
ALL = [FeatureParams(), BAND, SEARCH, HeatParams(), RegionParams(), TrackParams()]
FRAMES = [(720, 1280), (540, 960), (375, 1242), (360, 480), (1280, 720), (2160, 3840), (1080, 1920)]


@pytest.mark.parametrize("params", ALL, ids=lambda each: type(each).__name__)
def test_every_field_is_checked_and_named(params):
    for field in (each.name for each in dataclasses.fields(params)):
        optional = field in ("spatial_color_space", "hist_color_space", "threshold")
        for value in ("nonsense", math.nan, -1e12, [1, 2], *[None] * (not optional)):
            with pytest.raises(InvalidInputError, match=rf"^{field}\b.* must be "):
                dataclasses.replace(params, **{field: value})


@pytest.mark.parametrize(
    ("params", "parts"),
    [
        (FeatureParams.preset("luv-2384"), (768, 48, 1568)),
        (FeatureParams.preset("ycrcb-6156"), (768, 96, 5292)),
        (FeatureParams.preset("ycrcb-8460"), (3072, 96, 5292)),
        (FeatureParams.preset("lab-9432"), (3072, 96, 5292 + 972)),
        (FeatureParams(spatial_feat=False, hist_feat=False), (0, 0, 5292)),
        (FeatureParams(spatial_size=(16, 16), hog_feat=False), (768, 96, 0)),
    ],
    ids=str,
)
def test_features_have_the_known_lengths(params, parts):
    assert (params.spatial_length, params.hist_length, params.hog_length) == parts
    assert params.length == sum(parts)
    patch = np.zeros((1, 64, 64, 3), np.uint8)
    assert extract_features(patch, params).shape == (1, params.length)
    assert single_img_features(patch[0], params).shape == (params.length,)


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (FeatureParams, {"hog_channel": 3}, "hog_channel must be one of 0, 1, 2, 'ALL', 'GRAY'"),
        (FeatureParams, {"spatial_size": (32, 16)}, "spatial_size must be an integer from 1 to 64"),
        (FeatureParams, dict.fromkeys(PARTS, False), "all False; set one to True"),
        (FeatureParams, {"pix_per_cell": 16, "cell_per_block": 5}, "cell_per_block must be .* from 1 to 4"),
        (FeatureParams, {"coarse_hog": True, "cell_per_block": 5}, "coarse_hog must be False, because a bl"),
        (FeatureParams.preset, {"name": "nothing"}, "preset must be one of '"),
        (SearchParams.preset, {"name": ["default"]}, "preset must be one of '"),
        (SearchBand, {"window": (64, 4), "y": (0, 9)}, r"window\[1\] must be a number, at least"),
        (SearchBand, {"window": (64, 64), "y": (10, 10)}, r"y must be .* start < stop, got \(10, 10\)"),
        (SearchBand, {"window": (64, 64), "y": (0, 9), "x": (0, 1280)}, r"x\[1\] must be .* at most 1"),
        (SearchParams, {"bands": ()}, "bands must be a tuple of SearchBand"),
        (SearchParams, {"bands": (BAND, "band")}, "bands must be a tuple of SearchBand"),
        (SEARCH.with_horizon, {"horizon": 1.2}, "horizon must be a number, at least 0 and at most 1"),
        (
            TrackParams,
            {"show_coast": 2, "max_coast": 1},
            "show_coast must be at most max_coast, .*got 2; change",
        ),
        (FunctionParams, {"min_score": None}, "min_score must be a number"),
    ],
)
def test_invalid_parameters_are_rejected(kind, arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        kind(**arguments)


def test_a_band_is_relative_to_the_horizon():
    assert SearchParams(bands=[BAND], horizon=0.5) == SEARCH
    assert SEARCH.with_horizon(None) is SEARCH
    everywhere = SearchParams.default().everywhere()
    assert {(band.y1, band.y2) for band in everywhere.place((720, 1280))} == {(0, 720)}
    params = SearchParams(bands=(SearchBand(window=(96, 48), y=(-20, 200), overlap=(0.5, 0.75)),))
    (band,) = params.with_horizon(0.5).place((720, 1280, 3))
    assert band == PixelBand(0, 340, 1280, 560, (96, 48), (48, 12))
    (lower,) = params.with_horizon(0.6).place((720, 1280, 3))
    assert (lower.y1, lower.y2) == (412, 632)


def test_a_band_scales_with_the_frame():
    (full,) = SEARCH.place((720, 1280))
    (half,) = SEARCH.place((360, 640))
    assert half == PixelBand(*(side // 2 for side in (full.x1, full.y1, full.x2, full.y2)), (32, 32), (4, 4))
    # A portrait frame scales by its longer side.
    assert SEARCH.place((1280, 720)) == (PixelBand(0, 640, 720, 896, (64, 64), (8, 8)),)
    bands = SearchParams.preset("three-scales").place((720, 1280))
    assert [band.window for band in bands] == [(96, 96), (64, 64), (51, 51)]
    assert {(band.x1, band.y1, band.x2, band.y2) for band in bands} == {(0, 400, 1280, 656)}


def test_bands_without_room_for_a_window_are_omitted():
    low = SearchBand(window=(64, 64), y=(330, 400))
    assert len(SearchParams(bands=(low, BAND), horizon=0.5).place((720, 1280))) == 1
    narrow = SearchBand(window=(64, 64), y=(0, 256), x=(0.5, 0.52))
    assert len(SearchParams(bands=(narrow, BAND), horizon=0.5).place((720, 1280))) == 1


sizes = st.floats(16, 400)
overlaps = st.floats(0, 0.95)


@given(
    st.tuples(st.integers(40, 1200), st.integers(40, 2000)),
    st.tuples(sizes, sizes),
    st.tuples(st.floats(-300, 0), st.floats(1, 500)),
    st.tuples(overlaps, overlaps),
    st.floats(0, 1),
    st.floats(0, 0.9),
)
def test_a_placed_band_is_inside_the_frame_and_has_windows(
    shape, window, y, overlap, horizon, horizontal_padding
):
    bands = (SearchBand(window=window, y=y, overlap=overlap),)
    params = SearchParams(bands=bands, horizon=horizon, horizontal_padding=horizontal_padding)
    try:
        (band,) = params.place(shape)
    except InvalidInputError:
        return
    height, width = shape
    assert 0 <= band.y1 < band.y2 <= height
    padding = round(horizontal_padding * band.window[0])
    assert -padding <= band.x1 < band.x2 <= width + padding
    assert all(1 <= step <= side for step, side in zip(band.step, band.window))
    windows = band_windows(band)
    assert len(windows) >= 1
    assert (windows[:, :2] >= (band.x1, band.y1)).all()
    assert (windows[:, 2:] <= (band.x2, band.y2)).all()


@pytest.mark.parametrize("preset", ["default", "three-scales"])
@pytest.mark.parametrize("shape", FRAMES)
def test_search_presets_fit_common_frame_sizes(shape, preset):
    bands = SearchParams.preset(preset).place(shape)
    assert all(0 <= band.y1 < band.y2 <= shape[0] for band in bands)
    # The road below the horizon is searched, across the whole width.
    assert min(band.x1 for band in bands) <= 0
    assert max(band.x2 for band in bands) >= shape[1]
    assert max(band.y2 for band in bands) > 0.7 * shape[0] or shape[0] > shape[1]


@pytest.mark.parametrize("shape", [(40, 40), (10, 10), (1, 1), (15, 100)])
@pytest.mark.parametrize("preset", ["default", "three-scales", "130-windows"])
def test_a_tiny_frame_is_rejected(shape, preset):
    message = f"^image of {shape[1]}x{shape[0]} pixels holds no search window .*; pass a larger image"
    with pytest.raises(InvalidInputError, match=message):
        SearchParams.preset(preset).place(shape)


WHOLE = HeatParams(weighting="count", peak_fraction=0)


def test_heat_thresholds_scale_with_the_density_of_the_windows():
    dense = SearchParams.preset()
    half = dataclasses.replace(
        dense, bands=tuple(dataclasses.replace(band, overlap=(0.75, 0.75)) for band in dense.bands)
    )
    assert half.window_density == pytest.approx(dense.window_density / 4)
    for heat in (WHOLE, HeatParams(), HeatParams(weighting="count"), HeatParams(peak_fraction=0)):
        assert heat_range(half, heat) == pytest.approx([value / 4 for value in heat_range(dense, heat)])
        for search in (dense, half, SearchParams.preset("three-scales"), SearchParams.preset("130-windows")):
            low, high = heat_range(search, heat)[1:]
            assert low <= heat.for_search(search).threshold <= high
    # The fast search steps by a cell or more.
    denser = dataclasses.replace(
        dense, bands=tuple(dataclasses.replace(band, overlap=(0.95, 0.95)) for band in dense.bands)
    )
    assert denser.window_density == dense.window_density


def test_a_given_heat_threshold_is_kept_and_checked_against_the_density():
    dense = SearchParams.preset()
    given_ = dataclasses.replace(WHOLE, threshold=20.0)
    assert given_.for_search(dense) is given_
    cases = [
        (dataclasses.replace(WHOLE, threshold=2.0), dense, "too many windows are hot.* expect 10 to 56;"),
        (dataclasses.replace(WHOLE, threshold=80.0), dense, "threshold 80 does not fit .*too few windows"),
        (HeatParams(threshold=90.0, weighting="count"), dense, "peak_fraction=0.35 expect 0 to 56;"),
    ]
    for params, search, message in cases:
        with pytest.warns(UserWarning, match=message):
            assert params.for_search(search) is params
    for search in (FunctionParams(), NetworkParams()):
        assert heat_range(search, WHOLE).high == np.inf


def test_values_of_numpy_become_those_of_python():
    """Parameters from ``numpy.arange`` are written into model files as JSON."""
    features = FeatureParams(
        orient=np.int64(9), hog_channel=np.int64(0), hist_gain=np.float32(2), coarse_hog=np.bool_(True)
    )
    for params in (
        features,
        NetworkParams(input_size=np.int64(640)),
        HeatParams(frames=np.int64(3), threshold=np.float64(2)),
        TrackParams(confirm_hits=np.int64(3)),
        RegionParams(min_peak=np.float32(0.5)),
    ):
        plain = json.loads(json.dumps(dataclasses.asdict(params)))
        assert type(params)(**plain) == params
