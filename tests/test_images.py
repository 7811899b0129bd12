import io
import itertools
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.helpers import FULL_DISK
from vehicle_detection.errors import InvalidInputError, OutputError
from vehicle_detection.images import decode_image, image_array, image_size, read_image, write_image


@pytest.fixture(scope="module")
def picture():
    """Smooth colors with a red top left corner, 40 rows of 60."""
    noise = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 4)
    image[:10, :20] = (250, 10, 10)
    return image


def encoded(suffix, array):
    """Encode an array in OpenCV's channel order."""
    return cv2.imencode(suffix, array)[1].tobytes()


def bgr(image):
    return np.ascontiguousarray(image[..., ::-1])


def test_the_content_of_a_file_is_an_image(tmp_path, picture):
    write_image(tmp_path / "a.png", picture)
    data = (tmp_path / "a.png").read_bytes()
    np.testing.assert_array_equal(read_image(data), picture)
    with pytest.raises(InvalidInputError, match=r"^the bytes must be a complete image file"):
        read_image(data[:100])
    for other in (io.BytesIO(data), bytearray(data)):
        with pytest.raises(InvalidInputError, match=r"path must be a file name or bytes, got .*; pass bytes"):
            read_image(other)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".JPG", ".WEBP"])
def test_an_image_is_unchanged_after_writing_and_reading(tmp_path, picture, suffix):
    """Lossy formats keep it approximately."""
    before, path = picture.copy(), tmp_path / f"a{suffix}"
    write_image(str(path), picture)
    np.testing.assert_array_equal(picture, before)
    image = read_image(path)
    assert (image.shape, image.dtype) == (picture.shape, np.uint8)
    assert image.flags.c_contiguous
    assert image.flags.writeable
    assert np.abs(image.astype(int) - picture).mean() < (3 if suffix.isupper() else 1e-9)
    write_image(path, picture[::2, ::2])
    assert np.abs(read_image(path).astype(int) - picture[::2, ::2]).mean() < 5


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff"])
def test_gray_becomes_three_equal_channels(picture, suffix):
    gray = picture[..., 1]
    image = decode_image(encoded(suffix, gray), "gray")
    assert image.shape == (40, 60, 3)
    assert (image == image[..., :1]).all()
    if suffix != ".jpg":
        np.testing.assert_array_equal(image[..., 0], gray)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("channels", [1, 3])
def test_sixteen_bits_are_scaled_to_eight(suffix, channels, caplog):
    ramp = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    array = ramp if channels == 1 else np.dstack([ramp] * 3)
    image = decode_image(encoded(suffix, array), "deep")
    assert image.shape == (256, 256, 3)
    assert image.dtype == np.uint8
    # Libraries differ in how they round.
    assert np.abs(image.astype(float) - ramp[..., None] / 257).max() < 1
    assert (image.min(), image.max()) == (0, 255)
    assert not caplog.text
    decode_image(encoded(suffix, array >> 2), "14 bits")
    assert "14 bits is nearly black: its values use few of their 16 bits" in caplog.text


def test_a_palette_becomes_rgb_and_alpha_is_dropped(picture):
    buffer = io.BytesIO()
    indexed = Image.fromarray(picture).quantize(16)
    indexed.save(buffer, "PNG")
    expected = np.array(indexed.convert("RGB"))
    np.testing.assert_array_equal(decode_image(buffer.getvalue(), "indexed"), expected)
    with_alpha = np.dstack([bgr(picture), np.full((40, 60), 30, np.uint8)])
    np.testing.assert_array_equal(decode_image(encoded(".png", with_alpha), "rgba"), picture)


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_exif_rotation_is_applied(picture, orientation, turns):
    exif = Image.Exif()
    exif[0x0112] = orientation
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=95, exif=exif)
    image = decode_image(buffer.getvalue(), "rotated")
    upright = np.rot90(picture, turns)
    assert image.shape == upright.shape
    assert np.abs(image.astype(int) - upright).mean() < 3


@pytest.mark.parametrize(
    ("suffix", "fraction"),
    [*itertools.product([".png", ".jpg", ".bmp", ".webp"], [0.02, 0.3, 0.7, 0.99]), (".jpg", 0.9999)],
)
def test_a_truncated_file_is_refused(tmp_path, picture, suffix, fraction):
    data = encoded(suffix, bgr(picture))
    file = tmp_path / f"cut{suffix}"
    file.write_bytes(data[: int(len(data) * fraction)])
    with pytest.raises(InvalidInputError, match=r"image file .*cut.* must be a complete image .*decoded"):
        read_image(file)


def test_a_truncated_jpeg_with_a_complete_thumbnail_is_refused(picture):
    thumbnail = encoded(".jpg", bgr(picture[::4, ::4]))
    whole = encoded(".jpg", bgr(picture))
    # The thumbnail, with its own end marker, lies in a segment of the header.
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    with_thumbnail = whole[:2] + segment + whole[2:]
    for appended in (b"", b"\0\0\0\x18ftypmp42 \xff\xda video of a phone"):
        assert decode_image(with_thumbnail + appended, "a.jpg").shape == picture.shape
    with pytest.raises(InvalidInputError, match="complete image file"):
        decode_image(with_thumbnail[: -len(whole) // 3], "a.jpg")


def claim(data, width, height):
    """Change the size that the header of a PNG or JPEG claims."""
    data = bytearray(data)
    if data.startswith(b"\x89PNG"):
        data[16:24] = struct.pack(">II", width, height)
        data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    else:
        struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, height, width)
    return bytes(data)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("side", [30_000, 11_000])
def test_an_image_that_claims_to_be_huge_is_refused_before_it_is_decoded(picture, monkeypatch, suffix, side):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    message = rf"huge must have at most 120,000,000 pixels, got {side}x{side}; .*VEHICLE_DETECTION_MAX_PIXELS"
    with pytest.raises(InvalidInputError, match=message):
        decode_image(claim(encoded(suffix, bgr(picture)), side, side), "huge")


def test_the_limit_of_pixels_is_adjustable(picture, monkeypatch):
    data = encoded(".png", bgr(picture))
    monkeypatch.setenv("VEHICLE_DETECTION_MAX_PIXELS", str(picture.size // 3))
    np.testing.assert_array_equal(decode_image(data, "a.png"), picture)
    monkeypatch.setenv("VEHICLE_DETECTION_MAX_PIXELS", str(picture.size // 3 - 1))
    with pytest.raises(InvalidInputError, match=r"^the bytes must have at most 2,399 pixels, got 60x40"):
        read_image(data)
    for text in ("many", "0", "-1", "1" * 30):
        monkeypatch.setenv("VEHICLE_DETECTION_MAX_PIXELS", text)
        with pytest.raises(InvalidInputError, match="_MAX_PIXELS must be a number of pixels"):
            decode_image(data, "a.png")


@pytest.mark.parametrize("suffix", [".png", ".webp", ".gif", ".tif"])
def test_several_images_in_a_file_are_one_with_a_warning(tmp_path, suffix, caplog):
    first, second = (Image.new("RGB", (40, 30), color) for color in ("red", "blue"))
    for others in ([], [second]):
        first.save(tmp_path / f"a{suffix}", save_all=True, append_images=others, lossless=True)
        assert np.abs(read_image(tmp_path / f"a{suffix}") - [255.0, 0, 0]).max() < 2
        assert ("several pictures" in caplog.text) == bool(others)


SUFFIXES = [".png", ".jpg", ".bmp", ".tiff", ".webp", ".gif", ".ppm", ".pgm", ".pbm", ".jp2"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_size_of_an_image_is_that_of_its_header(suffix):
    if not cv2.haveImageWriter(f"image{suffix}"):
        pytest.skip(f"this OpenCV writes no {suffix}")
    image = np.zeros((37, 53) if suffix in (".pgm", ".pbm") else (37, 53, 3), np.uint8)
    data = encoded(suffix, image)
    assert image_size(data) == (53, 37)
    for length in (0, 4, 12, 24):  # a header that is cut off has no size, or the right one
        assert image_size(data[:length]) in (None, (53, 37))


def test_a_pipe_or_device_is_no_image(tmp_path):
    pipe = tmp_path / "pipe.png"
    os.mkfifo(pipe)
    for path in (pipe, os.devnull):
        with pytest.raises(InvalidInputError, match="is a device or a pipe, which may never end"):
            read_image(path)


RAW = io.BytesIO()
Image.new("RGB", (9, 9)).save(RAW, "TIFF", tiffinfo={254: 1})


@pytest.mark.parametrize(
    ("begin", "reason"),
    [
        *((begin, "complete") for begin in (b"not an image", b"\x89PNG\r\n\x1a\n", b"\xff\xd8", bytes(1000))),
        (b"", "must be a complete image file .* it is empty"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS, run git lfs pull"),
        (b"\n<html><body>", "it is a web page"),
        (RAW.getvalue(), "must be no raw photo, which holds a small preview"),
        (b"\0\0\0\x20ftypavif", "it is AVIF, convert it to PNG or JPEG"),
        (b"\0\0\0\x20ftypisom", "it is a video, which vehicle_detection.track reads"),
        (b"RIFF\0\0\0\0AVI LIST", "it is a video"),
        (b"\x1aE\xdf\xa3", "it is a video"),
        (b"G" + bytes(187) + b"G", "it is a video"),
    ],
)
def test_a_file_without_an_image_is_refused(begin, reason):
    with pytest.raises(InvalidInputError, match=reason):
        read_image(begin)


def test_images_of_pillow_with_16_bits_become_8_bits(picture):
    gray = np.ascontiguousarray(picture[..., 0])
    deep = Image.fromarray(gray.astype(np.uint16) * 257)
    assert deep.mode == "I;16"
    np.testing.assert_array_equal(image_array(deep), np.stack([gray] * 3, axis=2))
    for mode in ("I", "F"):
        with pytest.raises(InvalidInputError, match=f"range of values that is known, .* mode {mode}; scale"):
            image_array(Image.new(mode, (64, 64)))


def test_a_failed_write_keeps_the_earlier_file(tmp_path, picture, monkeypatch):
    write_image(tmp_path / "a.png", picture)
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, None))
    with pytest.raises(InvalidInputError, match=r"image cannot be encoded as .png; choose another format"):
        write_image(tmp_path / "a.png", 255 - picture)
    monkeypatch.undo()
    monkeypatch.setattr(Path, "write_bytes", FULL_DISK)
    with pytest.raises(OutputError, match=r"a.png cannot be written \(No space left on device\); free some"):
        write_image(tmp_path / "a.png", 255 - picture)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), picture)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: read_image("nothing.png"), r"image file nothing.png does not exist; check the path"),
        (lambda _: read_image("."), r"image file \. is a folder; choose a file in it"),
        (lambda _: read_image("ftp://host/a.jpg"), r"URL ftp://host/a.jpg must begin with http"),
        (lambda image: write_image("nowhere/a.png", image), "path needs an existing folder"),
        (lambda image: write_image("a.png", image[..., 0]), "image must be an"),
        (lambda image: write_image("folder.png", image), "path must be a file, got the folder"),
        *(
            (lambda image, name=name: write_image(name, image), "path must end in .png, .jpg or another")
            for name in ("a.xyz", "a", "a.", ".png", "a.txt")
        ),
    ],
)
def test_bad_paths_and_images(tmp_path, monkeypatch, picture, call, message):
    monkeypatch.chdir(tmp_path)
    Path("folder.png").mkdir()
    with pytest.raises(InvalidInputError, match=message):
        call(picture)
    assert os.listdir(tmp_path) == ["folder.png"]
