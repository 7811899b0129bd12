"""The lesson functions by their definition: NumPy, OpenCV, scikit-image, one window at a time.

A reference for the tests of `vehicle_detection.course`. The two modules are interchangeable.
"""

import cv2
import matplotlib.image as mpimg
import numpy as np
from skimage.feature import hog

SPACES = ("HSV", "LUV", "HLS", "YUV", "YCrCb", "LAB")


def convert_color(img, conv="RGB2YCrCb"):
    return cv2.cvtColor(img, getattr(cv2, f"COLOR_{conv}"))


def to_space(img, space):
    return convert_color(img, f"RGB2{space}") if space in SPACES else np.copy(img)


def get_hog_features(
    img, orient, pix_per_cell, cell_per_block, vis=False, feature_vec=True, *, transform_sqrt=False
):
    return hog(
        img,
        orientations=orient,
        pixels_per_cell=(pix_per_cell, pix_per_cell),
        cells_per_block=(cell_per_block, cell_per_block),
        block_norm="L2-Hys",
        transform_sqrt=transform_sqrt,
        visualize=vis,
        feature_vector=feature_vec,
    )


def bin_spatial(img, size=(32, 32), *, order="interleaved"):
    if order == "interleaved":
        return cv2.resize(img, size).ravel()
    return np.hstack([cv2.resize(img[:, :, channel], size).ravel() for channel in range(3)])


def color_hist(img, nbins=32, bins_range=(0, 256)):
    counts = [np.histogram(img[:, :, channel], bins=nbins, range=bins_range)[0] for channel in range(3)]
    return np.concatenate(counts)


def single_img_features(
    img, color_space="RGB", spatial_size=(32, 32), hist_bins=32, orient=9, pix_per_cell=8,
    cell_per_block=2, hog_channel=0, spatial_feat=True, hist_feat=True, hog_feat=True, *,
    hist_range=(0, 256), transform_sqrt=False, spatial_order="interleaved",
):  # fmt: skip
    converted = to_space(img, color_space)
    parts = []
    if spatial_feat:
        parts.append(bin_spatial(converted, spatial_size, order=spatial_order))
    if hist_feat:
        parts.append(color_hist(converted, hist_bins, hist_range))
    if hog_feat:
        channels = range(3) if hog_channel == "ALL" else [hog_channel]
        for channel in channels:
            plane = converted[:, :, channel]
            parts.append(
                get_hog_features(plane, orient, pix_per_cell, cell_per_block, transform_sqrt=transform_sqrt)
            )
    return np.concatenate(parts)


def read(file):
    if str(file).endswith(".png"):
        return mpimg.imread(file)
    # OpenCV rather than Pillow: JPEG decoders may differ by rounding.
    return cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)


def extract_features(imgs, *args, cspace=None, **options):
    if cspace is not None:
        # Two earlier quizzes: one of HOG alone, one of colors alone.
        options["color_space"] = cspace
        if "orient" in options:
            options |= {"spatial_feat": False, "hist_feat": False}
        else:
            options |= {"hog_feat": False}
    images = (img if isinstance(img, np.ndarray) else read(img) for img in imgs)
    return [single_img_features(image, *args, **options) for image in images]


def slide_window(
    img, x_start_stop=(None, None), y_start_stop=(None, None), xy_window=(64, 64), xy_overlap=(0.5, 0.5), *,
    formula="old",
):  # fmt: skip
    starts = []
    for limits, size, side, overlap in zip(
        (x_start_stop, y_start_stop), img.shape[1::-1], xy_window, xy_overlap
    ):
        first = limits[0] or 0
        span = (size if limits[1] is None else limits[1]) - first
        step = int(side * (1 - overlap))
        count = int(span / step) - 1 if formula == "old" else int((span - int(side * overlap)) / step)
        starts.append([first + index * step for index in range(count)])
    return [((x, y), (x + xy_window[0], y + xy_window[1])) for y in starts[1] for x in starts[0]]


def draw_boxes(img, bboxes, color=(0, 0, 255), thick=6):
    drawn = np.copy(img)
    for corner, opposite in bboxes:
        cv2.rectangle(drawn, corner, opposite, color, thick)
    return drawn


def search_windows(
    img, windows, clf, scaler, color_space="RGB", spatial_size=(32, 32), hist_bins=32, hist_range=(0, 256),
    orient=9, pix_per_cell=8, cell_per_block=2, hog_channel=0, spatial_feat=True, hist_feat=True,
    hog_feat=True, **options,
):  # fmt: skip
    found = []
    for window in windows:
        (x1, y1), (x2, y2) = window
        features = single_img_features(
            cv2.resize(img[y1:y2, x1:x2], (64, 64)), color_space, spatial_size, hist_bins, orient,
            pix_per_cell, cell_per_block, hog_channel, spatial_feat, hist_feat, hog_feat,
            hist_range=hist_range, **options,
        )  # fmt: skip
        if clf.predict(scaler.transform(features.reshape(1, -1))) == 1:
            found.append(window)
    return found


def find_car_windows(
    img, ystart, ystop, scale, svc, X_scaler, orient, pix_per_cell, cell_per_block, spatial_size, hist_bins,
    *, color_space="YCrCb", hog_channel="ALL", spatial_feat=True, hist_feat=True, hog_feat=True,
    hist_range=(0, 256), transform_sqrt=False, spatial_order="interleaved", cells_per_step=2, divide_by=255,
    resize="after conversion", formula="old",
):  # fmt: skip
    band = img[ystart:ystop]
    if divide_by != 1:
        band = band.astype(np.float32) / divide_by
    size = (int(band.shape[1] / scale), int(band.shape[0] / scale))
    if resize == "after conversion":
        band = to_space(band, color_space)
        band = cv2.resize(band, size) if scale != 1 else band
    else:
        band = cv2.resize(band, size) if scale != 1 else band
        band = to_space(band, color_space)
    blocks_x = band.shape[1] // pix_per_cell - cell_per_block + 1
    blocks_y = band.shape[0] // pix_per_cell - cell_per_block + 1
    per_window = 64 // pix_per_cell - cell_per_block + 1
    extra = 1 if formula == "new" else 0
    channels = range(3) if hog_channel == "ALL" else [hog_channel]
    hogs = [
        get_hog_features(
            band[:, :, channel], orient, pix_per_cell, cell_per_block, feature_vec=False,
            transform_sqrt=transform_sqrt,
        )
        for channel in channels
    ]  # fmt: skip
    boxes = []
    for step_x in range((blocks_x - per_window) // cells_per_step + extra):
        for step_y in range((blocks_y - per_window) // cells_per_step + extra):
            x, y = step_x * cells_per_step, step_y * cells_per_step
            left, top = x * pix_per_cell, y * pix_per_cell
            window = cv2.resize(band[top : top + 64, left : left + 64], (64, 64))
            parts = []
            if spatial_feat:
                parts.append(bin_spatial(window, spatial_size, order=spatial_order))
            if hist_feat:
                parts.append(color_hist(window, hist_bins, hist_range))
            if hog_feat:
                parts += [part[y : y + per_window, x : x + per_window].ravel() for part in hogs]
            features = X_scaler.transform(np.hstack(parts).reshape(1, -1))
            if svc.predict(features) == 1:
                x1, y1, side = int(left * scale), int(top * scale) + ystart, int(64 * scale)
                boxes.append(((x1, y1), (x1 + side, y1 + side)))
    return boxes


def find_cars(img, *args, **options):
    return draw_boxes(img, find_car_windows(img, *args, **options))


def add_heat(heatmap, bbox_list):
    for (x1, y1), (x2, y2) in bbox_list:
        heatmap[y1:y2, x1:x2] += 1
    return heatmap


def apply_threshold(heatmap, threshold):
    heatmap[heatmap <= threshold] = 0
    return heatmap


def draw_labeled_bboxes(img, labels):
    for number in range(1, labels[1] + 1):
        rows, columns = (labels[0] == number).nonzero()
        first, last = (int(columns.min()), int(rows.min())), (int(columns.max()), int(rows.max()))
        cv2.rectangle(img, first, last, (0, 0, 255), 6)
    return img
