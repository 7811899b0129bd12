import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")

from vehicle_detection.training.architecture import cell_centers  # noqa: E402
from vehicle_detection.training.loss import Targets, _assign, detection_loss  # noqa: E402

HEIGHT, WIDTH = 64, 96
CENTERS, STRIDES = cell_centers(HEIGHT, WIDTH, torch.device("cpu"))
VEHICLE = [10.0, 12, 60, 50]


def targets(boxes=(), ignored=()):
    boxes, ignored = (torch.tensor([list(each) or [[0.0] * 4]]) for each in (boxes, ignored))
    return Targets(boxes, (boxes[..., 2:] > boxes[..., :2]).all(-1), ignored)


def predict(box=VEHICLE, logit=-8.0):
    """Predict the same box everywhere."""
    return torch.full((1, len(CENTERS)), logit), torch.tensor(box).expand(1, len(CENTERS), 4).clone()


def inside(box):
    x, y = CENTERS.T
    return (x > box[0]) & (x < box[2]) & (y > box[1]) & (y < box[3])


def test_a_perfect_box_has_no_box_loss():
    _, loss = detection_loss(*predict(), CENTERS, targets([VEHICLE]))
    assert loss.item() == pytest.approx(0, abs=1e-4)
    _, shifted = detection_loss(*predict([14.0, 12, 64, 50]), CENTERS, targets([VEHICLE]))
    assert shifted.item() > 0.1


def test_a_right_score_has_less_loss_than_a_wrong_one():
    logits, boxes = predict()
    target, _ = _assign(logits, boxes, CENTERS, *targets([VEHICLE])[:2])
    right = torch.where(target > 0.5, 4.0, -8.0)
    losses = [detection_loss(each, boxes, CENTERS, targets([VEHICLE]))[0] for each in (right, logits)]
    assert losses[0] < losses[1] / 5


def test_only_cells_inside_a_vehicle_answer_for_it():
    logits, boxes = predict()
    small = [70.0, 20, 90, 40]
    target, vehicle = _assign(logits, boxes, CENTERS, *targets([VEHICLE, small])[:2])
    answers = target[0] > 0
    assert 0 < answers.sum() <= 10
    assert bool(inside(VEHICLE)[answers].all())
    assert vehicle[0][answers].unique().tolist() == [0]


def test_ignored_boxes_have_no_loss():
    logits, boxes = predict(logit=-8.0)
    logits[0, inside(VEHICLE)] = 5.0
    counted, _ = detection_loss(logits, boxes, CENTERS, targets())
    score, box = detection_loss(logits, boxes, CENTERS, targets(ignored=[VEHICLE]))
    assert counted.item() > 1
    assert score.item() < 1e-3
    assert box.item() == 0
