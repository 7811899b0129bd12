import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import SMALL_MIXTURE, drawn
from vehicle_detection.boxes import iou_matrix
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.mixture import N_CHANNELS, EdgePyramid, MixtureTemplate, mirror_channels
from vehicle_detection.mixture_training import FrameDataset, train_mixture
from vehicle_detection.mixture_training.patches import (
    BoxRegressor,
    fit_box_regressor,
    locate_on_patch,
    patch_features,
)
from vehicle_detection.mixture_training.positives import (
    align_mirrored,
    jitter_boxes,
    truncated_vehicles,
    vehicle_features,
    whole_vehicles,
    window_features,
)
from vehicle_detection.mixture_training.sources import TrainingFrame, load_training_frames


def flat(samples):
    """Pairs of an image and one box."""
    return [(image, box) for image, boxes in samples for box in boxes]


def blank(columns=8, rows=7):
    return MixtureTemplate(np.zeros((rows, columns, N_CHANNELS)), 0.0, (1.0, 1.0))


def test_whole_vehicles_are_also_taken_from_relit_frames(drawn_source):
    frames = load_training_frames([drawn_source])
    wide = [box for frame in frames for box in frame.boxes if box[2] - box[0] >= SMALL_MIXTURE.min_width]
    for count in (0, 2):
        params = dataclasses.replace(SMALL_MIXTURE, copies=3, relit_copies=count)
        seen = list(whole_vehicles(frames, params, np.random.default_rng(0)))
        assert sum(len(boxes) for _, boxes in seen) == (3 + count) * len(wide)
        unknown = [boxes for image, boxes in seen if not any(image is frame.image for frame in frames)]
        relit = [box for boxes in unknown for box in boxes]
        assert len(relit) == count * len(wide)
        assert {tuple(box) for box in relit} == ({tuple(box) for box in wide} if count else set())


@given(seed=st.integers(0, 1000), count=st.integers(0, 8))
def test_jittered_boxes_still_overlap_their_vehicles(seed, count):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 500, (count, 2))
    boxes = np.hstack([corners, corners + rng.uniform(20, 200, (count, 2))])
    moved = jitter_boxes(boxes, rng)
    assert moved.shape == boxes.shape
    if count:
        assert (np.diag(iou_matrix(boxes, moved)) > 0.15).all()
        ratio = (moved[:, 2:] - moved[:, :2]) / (boxes[:, 2:] - boxes[:, :2])
        assert (ratio > np.exp(-0.6) - 1e-9).all()
        assert (ratio < np.exp(0.45) + 1e-9).all()


def test_truncated_vehicles_end_at_the_border(drawn_source):
    params = dataclasses.replace(SMALL_MIXTURE, border_shapes=((4, 5),))
    frames = load_training_frames([drawn_source])
    seen = flat(truncated_vehicles(frames, params, np.random.default_rng(0)))
    assert len(seen) > len(frames)
    for image, box in seen:
        assert box[2] == image.shape[1]
        assert box[2] - box[0] >= params.min_width * (1 - params.jitter_scale)


def test_a_vehicle_truncated_by_the_border_is_copied():
    cut = TrainingFrame(
        np.zeros((90, 160, 3), np.uint8), np.array([[110.0, 20, 160, 60]]), np.empty((0, 4)), 0.0
    )
    for copies in (1, 5):
        params = dataclasses.replace(SMALL_MIXTURE, border_copies=copies)
        found = flat(truncated_vehicles([cut], params, np.random.default_rng(0)))
        seen = [box for _, box in found if box[2] == 160]
        assert len(seen) == copies
        assert seen[0].tolist() == [110, 20, 160, 60]
        assert len({tuple(box) for box in seen}) == len(seen)


def test_aligned_samples_show_the_same_side():
    rng = np.random.default_rng(5)
    side = rng.normal(0, 1, (4, 6, N_CHANNELS)).astype(np.float32)
    mirrored = mirror_channels(side.transpose(2, 0, 1)).transpose(1, 2, 0)
    views = np.stack([side.ravel(), mirrored.ravel()])
    flipped = rng.integers(0, 2, 60)
    pairs = np.stack([views[[flip, 1 - flip]] for flip in flipped])
    rows = (pairs + rng.normal(0, 0.5, pairs.shape)).astype(np.float32).reshape(120, -1)
    chosen = align_mirrored(rows, np.random.default_rng(0))
    assert chosen.shape == (60, side.size)
    nearer = np.array([np.linalg.norm(chosen - view, axis=1) for view in views]).argmin(axis=0)
    assert len(set(nearer.tolist())) == 1
    for index, row in enumerate(chosen):
        assert any((row == pair).all() for pair in rows[2 * index : 2 * index + 2])
    assert align_mirrored(np.empty((0, 8), np.float32), rng).shape == (0, 8)


def test_the_regressor_corrects_misplaced_boxes(drawn_source):
    frames = load_training_frames([drawn_source])
    with ThreadPoolExecutor(1) as pool:
        regressor = fit_box_regressor(frames, SMALL_MIXTURE, np.random.default_rng(0), pool)
    before, after = [], []
    for frame in load_training_frames([FrameDataset("others", (drawn(range(20, 30)),))]):
        wide = frame.boxes[frame.boxes[:, 2] - frame.boxes[:, 0] >= SMALL_MIXTURE.min_width]
        boxes = jitter_boxes(wide, np.random.default_rng(5))
        shifts = regressor.shifts(EdgePyramid(frame.image), boxes)
        corrected = boxes + shifts * np.tile(boxes[:, 2:] - boxes[:, :2], 2)
        before += np.diag(iou_matrix(boxes, wide)).tolist()
        after += np.diag(iou_matrix(corrected, wide)).tolist()
        box = locate_on_patch(frame.image, regressor)
        assert (box[:2] >= 0).all()
        assert (box[2:] <= frame.image.shape[1::-1]).all()
    assert len(before) > 10
    assert np.mean(after) > np.mean(before) + 0.1


def test_cells_outside_a_patch_take_the_mean_features():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (60, 80, 3), np.uint8)
    template, none = blank(), BoxRegressor.none()
    known = rng.normal(0, 1, (5, template.weights.size)).astype(np.float32)
    (rows,) = patch_features([image], none, [template], [known], SMALL_MIXTURE)
    plain, mirrored = rows.reshape(2, 7, 8, N_CHANNELS)
    mean = known.mean(axis=0).reshape(7, 8, N_CHANNELS)
    # The box leaves 5% of the width at the sides, a third of a cell; above and below there is nearly a cell.
    ring = np.zeros((7, 8), bool)
    ring[:, [0, -1]] = True
    np.testing.assert_allclose(plain[ring], mean[ring], rtol=1e-6)
    own = window_features(EdgePyramid(image), locate_on_patch(image, none), template).transpose(1, 2, 0)
    np.testing.assert_array_equal(plain[~ring], own[~ring])
    back = mirror_channels(mirrored.transpose(2, 0, 1)).transpose(1, 2, 0)
    np.testing.assert_array_equal(back, plain)


def test_a_patch_with_a_wide_margin_needs_no_mean_features():
    image = np.random.default_rng(0).integers(0, 256, (200, 200, 3), np.uint8)
    # A regressor that shrinks every box.
    shrink = BoxRegressor(np.zeros_like(BoxRegressor.none().weights), [0.2, 0.2, -0.2, -0.2])
    known = np.zeros((1, blank().weights.size), np.float32)
    (rows,) = patch_features([image], shrink, [blank()], [known], SMALL_MIXTURE)
    own = window_features(EdgePyramid(image), locate_on_patch(image, shrink), blank())
    np.testing.assert_array_equal(rows[0], own.transpose(1, 2, 0).ravel())


def test_patches_train_templates_of_their_shape(drawn_source):
    frames = load_training_frames([drawn_source])
    params = dataclasses.replace(SMALL_MIXTURE, aspect_tolerance=0.0)
    templates = [blank(8, 7), blank(5, 12)]
    known = vehicle_features(whole_vehicles(frames, params, np.random.default_rng(0)), templates, params)
    known = [
        rows if len(rows) else np.zeros((1, t.weights.size), np.float32) for t, rows in zip(templates, known)
    ]
    image = np.zeros((64, 64, 3), np.uint8)
    counts = [len(rows) for rows in patch_features([image], BoxRegressor.none(), templates, known, params)]
    assert counts == [2, 0]


@pytest.mark.parametrize(
    ("patches", "message"),
    [
        (5, "patches must be"),
        ([np.zeros((64, 64), np.uint8)], "patches must be"),
        ([np.zeros((64, 64, 3))], "patches must be"),
    ],
    ids=["number", "gray", "float"],
)
def test_invalid_patches(drawn_source, patches, message):
    with pytest.raises(InvalidInputError, match=message):
        train_mixture([drawn_source], SMALL_MIXTURE, patches=patches, n_jobs=1)


def test_patches_add_positive_samples(drawn_source):
    frames = load_training_frames([drawn_source])
    boxes = [(frame.image, *frame.boxes[0].astype(int)) for frame in frames if len(frame.boxes)]
    patches = [image[max(y1 - 2, 0) : y2 + 2, max(x1 - 2, 0) : x2 + 2] for image, x1, y1, x2, y2 in boxes]
    params = dataclasses.replace(SMALL_MIXTURE, mining_schedule=(0.2,))
    lines = []
    models = [
        train_mixture([drawn_source], params, patches=given, n_jobs=jobs, on_step=lines.append)
        for given, jobs in (((), 1), (patches, 1), (patches, 2))
    ]
    plain, one, two = (model.templates[0].weights for model in models)
    assert (plain != one).any()
    np.testing.assert_array_equal(one, two)
    counts = [int(line.split()[-1]) for line in lines if line.startswith("vehicles per template: ")]
    assert counts[1] - counts[0] == 2 * len(patches)
