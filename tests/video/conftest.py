"""Fixtures for the tests of video."""

import gc

import pytest

from tests.video.clips import NTSC, child_processes, ffmpeg, gray_frames, running_threads, write_clip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("clips")


@pytest.fixture(scope="module")
def clip(folder):
    return write_clip(folder / "clip.mp4", gray_frames(20), fps=NTSC, sound=True)


@pytest.fixture(autouse=True)
def no_leftovers():
    before = child_processes()
    yield
    if child_processes() != before or running_threads():
        gc.collect()  # takes tenths of a second
    assert child_processes() == before
    assert not running_threads()


@pytest.fixture
def truncated(folder):
    pattern = ["-f", "lavfi", "-i", "testsrc2=s=160x90:r=25", "-frames:v", 100, "-pix_fmt", "yuv420p"]

    def make(name, *options):
        whole = folder / f"whole_{name}"
        ffmpeg(*pattern, *options, whole)
        path = folder / name
        path.write_bytes(whole.read_bytes()[: whole.stat().st_size * 55 // 100])
        return path

    return make
