import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch, the extra [train]")

from vehicle_detection.training.architecture import CENTER, SCALE, STRIDES, Deployed, Network, cell_centers  # noqa: E402


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return Network().eval()


@pytest.mark.parametrize(("height", "width"), [(64, 64), (96, 160), (32, 224)])
def test_a_box_for_each_cell_also_at_levels_of_odd_size(network, height, width):
    with torch.no_grad():
        logits, boxes = network(torch.zeros(2, height, width, 3, dtype=torch.uint8))
    cells = sum(-(-height // stride) * -(-width // stride) for stride in STRIDES)
    assert logits.shape == (2, cells)
    assert boxes.shape == (2, cells, 4)
    assert len(cell_centers(height, width, torch.device("cpu"))[0]) == cells


def test_boxes_contain_the_centers_of_their_cells(network):
    with torch.no_grad():
        _, (boxes,) = network(torch.randint(256, (1, 96, 160, 3), dtype=torch.uint8))
    centers, _ = cell_centers(96, 160, torch.device("cpu"))
    assert bool((boxes[:, :2] < centers).all())
    assert bool((boxes[:, 2:] > centers).all())


def test_the_deployed_network_returns_the_same_boxes(network):
    image = torch.randint(256, (1, 96, 160, 3), dtype=torch.uint8)
    with torch.no_grad():
        (logits,), (boxes,) = network(image)
        (rows,) = Deployed(network)((image.float() - CENTER) / SCALE)
    x, y, w, h, probability = rows
    torch.testing.assert_close(probability, logits.sigmoid())
    corners = torch.stack([x - w / 2, y - h / 2, x + w / 2, y + h / 2], 1)
    torch.testing.assert_close(corners, boxes, atol=1e-3, rtol=1e-4)
