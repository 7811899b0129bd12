"""The pipeline, to read: features, training, windows, search, heat, labels and boxes as in the course.

Plain NumPy, OpenCV, scikit-image and scikit-learn, one window at a time. The functions of the same names in
`vehicle_detection.course` return the same, only faster, and check their arguments; the tests compare the two.
Images are ``(H, W, 3)`` RGB, and a window is a pair of corners ``((x1, y1), (x2, y2))``.
"""

from collections import deque
from typing import Any

import cv2
import matplotlib.image as mpimg
import numpy as np
from scipy.ndimage import label
from skimage.feature import hog
from sklearn.model_selection import train_test_split
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

# ---- Features of a 64x64 patch: [spatial bins | color histogram | HOG] ----------------------------------


def convert_color(img: Any, conv: str = "RGB2YCrCb") -> Any:
    """Convert the color space. OpenCV's float images have other ranges than uint8 ones: hue is 0-360."""
    return cv2.cvtColor(img, getattr(cv2, f"COLOR_{conv}"))


def to_space(img: Any, color_space: str) -> Any:
    """Convert an RGB image to a color space by its name."""
    return np.copy(img) if color_space == "RGB" else convert_color(img, f"RGB2{color_space}")


def get_hog_features(
    img: Any, orient: int = 9, pix_per_cell: int = 8, cell_per_block: int = 2, vis: bool = False,
    feature_vec: bool = True, *, transform_sqrt: bool = False,
) -> Any:  # fmt: skip
    """HOG of one channel: a histogram of the gradients' directions, weighted by magnitude, in each cell.

    The cells of each block, neighbors of which overlap, are normalized together: v / |v|, clipped at 0.2,
    normalized again (L2-Hys). There are ``side // pix_per_cell - cell_per_block + 1`` blocks along a side,
    in a patch 7 x 7, each of 2 x 2 cells with 9 orientations: 1764 values. Pitfall: with and without
    `transform_sqrt` (HOG of the square root of the values), the vectors are equally long and do not mix.
    """
    cell, block = (pix_per_cell, pix_per_cell), (cell_per_block, cell_per_block)
    return hog(
        img, orient, cell, block, "L2-Hys", transform_sqrt=transform_sqrt, visualize=vis,
        feature_vector=feature_vec,
    )  # fmt: skip


def bin_spatial(img: Any, size: Any = (32, 32), *, order: str = "interleaved") -> Any:
    """Pixel values of the shrunken image. Pitfall: both orders are published and do not mix."""
    small = cv2.resize(img, size)
    return small.ravel() if order == "interleaved" else small.transpose(2, 0, 1).ravel()


def color_hist(img: Any, nbins: int = 32, bins_range: Any = (0, 256)) -> Any:
    """Histogram of each channel. Pitfall: with a range of 0-256, a 0-1 image fills the first bin only."""
    return np.concatenate([np.histogram(img[:, :, c], nbins, bins_range)[0] for c in range(3)])


def single_img_features(
    img: Any, color_space: str = "RGB", spatial_size: Any = (32, 32), hist_bins: int = 32, orient: int = 9,
    pix_per_cell: int = 8, cell_per_block: int = 2, hog_channel: Any = 0, spatial_feat: bool = True,
    hist_feat: bool = True, hog_feat: bool = True, *, hist_range: Any = (0, 256),
    transform_sqrt: bool = False, spatial_order: str = "interleaved",
) -> Any:  # fmt: skip
    """Feature vector of one image. YCrCb, 32, 32, 9, "ALL": 3072 + 96 + 3 * 1764 = 8460 values."""
    img, parts = to_space(img, color_space), []
    if spatial_feat:
        parts.append(bin_spatial(img, spatial_size, order=spatial_order))
    if hist_feat:
        parts.append(color_hist(img, hist_bins, hist_range))
    if hog_feat:
        for channel in range(3) if hog_channel == "ALL" else [hog_channel]:
            sizes = orient, pix_per_cell, cell_per_block
            parts.append(get_hog_features(img[:, :, channel], *sizes, transform_sqrt=transform_sqrt))
    return np.concatenate(parts)


def read_file(file: str, imread: str = "mpimg", channel_order: str = "RGB") -> Any:
    """Read an image. Pitfalls: ``mpimg.imread`` returns 0-1 for a PNG, ``cv2.imread`` blue first."""
    if imread == "mpimg" and file.endswith(".png"):
        img = mpimg.imread(file)
        return img if channel_order == "RGB" else img[:, :, ::-1]
    return cv2.imread(file, cv2.IMREAD_COLOR if channel_order == "BGR" else cv2.IMREAD_COLOR_RGB)


def extract_features(
    imgs: Any, *args: Any, imread: str = "mpimg", channel_order: str = "RGB", **options: Any
) -> Any:
    """Feature vectors of images or files; the other arguments are those of `single_img_features`."""
    read = (img if isinstance(img, np.ndarray) else read_file(img, imread, channel_order) for img in imgs)
    return [single_img_features(img, *args, **options) for img in read]


# ---- Classifier -----------------------------------------------------------------------------------------


def train(cars: Any, notcars: Any, **options: Any) -> tuple[Any, Any, float]:
    """Train a linear SVM on two lists of images or files: the SVM, the scaler, and the accuracy.

    Pitfall: neighboring patches show the same car, so a random split tests on near copies of what it was
    trained on, and its accuracy is too high. The scaler sees the training part only.
    """
    X = np.array(extract_features([*cars, *notcars], **options), np.float64)
    y = np.repeat([1, 0], [len(cars), len(notcars)])
    X_train, X_test, y_train, y_test = train_test_split(X, y, test_size=0.2, random_state=0)
    scaler = StandardScaler().fit(X_train)  # values of the three parts differ by orders of magnitude
    svc = LinearSVC(random_state=0).fit(scaler.transform(X_train), y_train)
    return svc, scaler, svc.score(scaler.transform(X_test), y_test)


# ---- Windows and search ---------------------------------------------------------------------------------


def slide_window(
    img: Any, x_start_stop: Any = (None, None), y_start_stop: Any = (None, None), xy_window: Any = (64, 64),
    xy_overlap: Any = (0.5, 0.5), *, formula: str = "old",
) -> list[Any]:  # fmt: skip
    """List the windows of one size in a region, row by row. Pitfall: two formulas count them.

    With overlaps above 0.5, the last windows of the old one extend beyond the region.
    """
    starts = []
    ranges = zip((x_start_stop, y_start_stop), img.shape[1::-1], xy_window, xy_overlap)
    for (start, stop), size, side, overlap in ranges:
        first = start or 0
        span, step = (size if stop is None else stop) - first, int(side * (1 - overlap))
        count = int(span / step) - 1 if formula == "old" else int((span - int(side * overlap)) / step)
        starts.append([first + index * step for index in range(count)])
    width, height = xy_window
    return [((x, y), (x + width, y + height)) for y in starts[1] for x in starts[0]]


def search_windows(
    img: Any, windows: Any, clf: Any, scaler: Any, color_space: str = "RGB", spatial_size: Any = (32, 32),
    hist_bins: int = 32, hist_range: Any = (0, 256), *args: Any, **options: Any,
) -> list[Any]:  # fmt: skip
    """Windows that the classifier takes for a vehicle, each resized to the size of a patch."""
    hits = []
    for (x1, y1), (x2, y2) in windows:
        patch = cv2.resize(img[y1:y2, x1:x2], (64, 64))
        features = single_img_features(
            patch, color_space, spatial_size, hist_bins, *args, hist_range=hist_range, **options
        )
        if clf.predict(scaler.transform([features])) == 1:
            hits.append(((x1, y1), (x2, y2)))
    return hits


def find_car_windows(
    img: Any, ystart: int, ystop: int, scale: float, svc: Any, X_scaler: Any, orient: int, pix_per_cell: int,
    cell_per_block: int, spatial_size: Any, hist_bins: int, *, color_space: str = "YCrCb",
    hog_channel: Any = "ALL", spatial_feat: bool = True, hist_feat: bool = True, hog_feat: bool = True,
    hist_range: Any = (0, 256), transform_sqrt: bool = False, spatial_order: str = "interleaved",
    cells_per_step: int = 2, divide_by: float = 255, resize: str = "after conversion", formula: str = "old",
) -> list[Any]:  # fmt: skip
    """Search a band of rows at one scale with one HOG for all windows, which are then slices of it.

    Shrinking the band by `scale` makes windows of 64 * scale pixels out of 64. HOG of a band has gradients at
    a window's border, HOG of a patch has none there, so scores differ a little from `search_windows`.
    """
    band = img[ystart:ystop]
    if divide_by != 1:  # for classifiers of PNG files, which are read as 0-1
        band = band.astype(np.float32) / divide_by
    size = int(band.shape[1] / scale), int(band.shape[0] / scale)
    if scale != 1 and resize == "before conversion":
        band = cv2.resize(band, size)
    band = to_space(band, color_space)
    if scale != 1 and resize == "after conversion":
        band = cv2.resize(band, size)
    sizes = orient, pix_per_cell, cell_per_block
    hogs = [
        get_hog_features(band[:, :, c], *sizes, feature_vec=False, transform_sqrt=transform_sqrt)
        for c in (range(3) if hog_channel == "ALL" else [hog_channel])
    ]
    blocks = 64 // pix_per_cell - cell_per_block + 1  # of a window, along a side
    rows, columns = (
        (side // pix_per_cell - cell_per_block + 1 - blocks) // cells_per_step + (formula == "new")
        for side in band.shape[:2]
    )
    hits = []
    for column in range(columns):
        for row in range(rows):
            x, y = column * cells_per_step, row * cells_per_step  # in cells
            left, top = x * pix_per_cell, y * pix_per_cell
            patch, parts = cv2.resize(band[top : top + 64, left : left + 64], (64, 64)), []
            if spatial_feat:
                parts.append(bin_spatial(patch, spatial_size, order=spatial_order))
            if hist_feat:
                parts.append(color_hist(patch, hist_bins, hist_range))
            if hog_feat:
                parts += [each[y : y + blocks, x : x + blocks].ravel() for each in hogs]
            if svc.predict(X_scaler.transform([np.concatenate(parts)])) == 1:
                x1, y1, side = int(left * scale), int(top * scale) + ystart, int(64 * scale)
                hits.append(((x1, y1), (x1 + side, y1 + side)))
    return hits


def find_cars(img: Any, *args: Any, **options: Any) -> Any:
    """Draw the hits of `find_car_windows` on a copy of the image."""
    return draw_boxes(img, find_car_windows(img, *args, **options))


# ---- Heat, labels and boxes -----------------------------------------------------------------------------


def add_heat(heatmap: Any, bbox_list: Any) -> Any:
    """Count the hits at each pixel, in place. Pitfall: uint8 overflows after 255 of them."""
    for (x1, y1), (x2, y2) in bbox_list:
        heatmap[y1:y2, x1:x2] += 1
    return heatmap


def apply_threshold(heatmap: Any, threshold: float) -> Any:
    """Remove heat up to the threshold, in place. It fits one density of windows only."""
    heatmap[heatmap <= threshold] = 0
    return heatmap


def labeled_bboxes(labels: Any) -> list[Any]:
    """Corners of each labeled region: its first and its last pixel."""
    regions = [np.nonzero(labels[0] == number) for number in range(1, labels[1] + 1)]
    return [((int(x.min()), int(y.min())), (int(x.max()), int(y.max()))) for y, x in regions]


def draw_boxes(img: Any, bboxes: Any, color: Any = (0, 0, 255), thick: int = 6) -> Any:
    """Draw boxes on a copy of an image."""
    drawn = np.copy(img)
    for corner, opposite in bboxes:
        cv2.rectangle(drawn, corner, opposite, color, thick)
    return drawn


def draw_labeled_bboxes(img: Any, labels: Any) -> Any:
    """Draw the box of each labeled region on the image itself."""
    for corner, opposite in labeled_bboxes(labels):
        cv2.rectangle(img, corner, opposite, (0, 0, 255), 6)
    return img


def process_frame(img: Any, hits: Any, history: deque[Any], threshold: float) -> Any:
    """Draw the vehicles of a frame of a video: mean heat of the last frames, threshold, labels, boxes."""
    history.append(add_heat(np.zeros(img.shape[:2]), hits))
    heat = apply_threshold(np.mean(history, axis=0), threshold)
    return draw_labeled_bboxes(np.copy(img), label(heat))
