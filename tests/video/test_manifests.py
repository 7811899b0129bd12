"""Playlists and manifests, which name other files, in place of videos."""

import contextlib
import socket
import threading

import pytest

from tests.video.clips import gray_frames, write_clip
from vehicle_detection import VehicleDetectionError, open_source

MANIFESTS = {
    "DASH": """<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static"
        mediaPresentationDuration="PT1S"><Period><AdaptationSet mimeType="video/mp4"><Representation id="1"
        bandwidth="1"><BaseURL>file:{path}</BaseURL></Representation></AdaptationSet></Period></MPD>""",
    "HLS": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:{path}\n#EXT-X-ENDLIST\n",
    "concat": "ffconcat version 1.0\nfile {path}\n",
    "SDP": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=a\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n"
    "a=rtpmap:96 H264/90000\n",
}


@pytest.fixture(params=MANIFESTS)
def manifest(request, tmp_path):
    """Bytes that name a video of somebody else."""
    private = write_clip(tmp_path / "private.ts", gray_frames(5))
    return MANIFESTS[request.param].format(path=private).encode()


@pytest.mark.parametrize("name", ["a.mp4", "a.ts", "a.m3u8"])
def test_files_that_name_others_are_refused(manifest, name, tmp_path):
    (tmp_path / name).write_bytes(manifest)
    with pytest.raises(VehicleDetectionError, match=name):
        open_source(tmp_path / name)
    (tmp_path / name).write_bytes(manifest + b"\0" * 9)
    with pytest.raises(VehicleDetectionError, match=name):
        open_source(tmp_path / name)


def test_streams_that_name_files_are_refused(manifest):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def send():
            with contextlib.suppress(OSError):
                while True:
                    client, _ = server.accept()
                    with client:
                        client.sendall(manifest)

        threading.Thread(target=send, daemon=True).start()
        with pytest.raises(VehicleDetectionError, match="tcp://"):
            open_source(f"tcp://127.0.0.1:{server.getsockname()[1]}", reconnect=False)
