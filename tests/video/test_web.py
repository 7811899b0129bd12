"""What web servers and files may refer to, and how long servers may take."""

import contextlib
import http.server
import socket
import threading
import time
from urllib.parse import urlsplit

import pytest

from tests.helpers import answer, serve
from tests.video.clips import gray_frames, write_clip
from vehicle_detection import (
    InvalidInputError,
    TransientVideoError,
    VehicleDetectionError,
    VideoError,
    open_source,
    read_image,
)
from vehicle_detection._common import web
from vehicle_detection.video import ffmpeg as ffmpeg_module
from vehicle_detection.video import files as files_module

DASH = """<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static"
    mediaPresentationDuration="PT1S"><Period><AdaptationSet mimeType="video/mp4"><Representation id="1"
    bandwidth="1"><BaseURL>{}</BaseURL></Representation></AdaptationSet></Period></MPD>"""
HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:0.2,\n{}\n#EXT-X-ENDLIST\n"
MANIFESTS = {
    "DASH": DASH,
    "HLS": HLS,
    "concat": "ffconcat version 1.0\nfile {}\n",
    "SDP": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=a\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n"
    "a=rtpmap:96 H264/90000\n",
}


@contextlib.contextmanager
def server(respond):
    """Serve requests; `respond` returns status, headers and body for a path. Yields address and paths."""
    paths = []

    def handle(request):
        paths.append(request.path)
        status, headers, body = respond(request.path)
        answer(request, status, body, headers)

    with serve(handle) as address:
        yield address, paths


@pytest.fixture(scope="module")
def data(folder):
    return write_clip(folder / "web.ts", gray_frames(5)).read_bytes()


def refer(kind, target, data):
    """Answer with the video, or at the path /first.m3u8 with a reference to it at another address."""

    def respond(path):
        if path != "/first.m3u8":
            return 200, {}, data
        if kind == "redirect":
            return 302, {"Location": target()}, b""
        return 200, {}, MANIFESTS[kind].format(target()).encode()

    return respond


@pytest.mark.parametrize(
    ("kind", "allowed"),
    [("redirect", False), ("HLS", False), ("DASH", False), ("redirect", True), ("HLS", True)],
)
def test_references_to_other_private_servers_are_refused(kind, allowed, data, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1,localhost")
    if allowed:
        monkeypatch.setenv(web.ALLOW_PRIVATE, "1")
    with (
        server(lambda _: (200, {}, data)) as (other, asked),
        server(refer(kind, lambda: f"{other}/a.ts", data)) as (address, _),
    ):
        if allowed:
            with open_source(f"{address}/first.m3u8", live=False, reconnect=False) as source:
                assert source.info.shape == (48, 64, 3)
            assert asked
        else:
            with pytest.raises(VideoError, match=rf"private address|{address}"):
                open_source(f"{address}/first.m3u8", reconnect=False)
            assert not asked


@pytest.mark.parametrize("kind", ["redirect", "HLS"])
def test_references_to_the_same_server_are_followed(kind, data):
    with (
        server(refer(kind, lambda: "/a.ts", data)) as (address, paths),
        open_source(f"{address}/first.m3u8", live=False, reconnect=False) as source,
    ):
        assert source.info.shape == (48, 64, 3)
    assert "/a.ts" in paths


def test_copies_of_redirected_files(data, tmp_path):
    with (
        server(lambda _: (200, {}, data)) as (other, asked),
        server(refer("redirect", lambda: f"{other}/a.ts", data)) as (address, _),
    ):
        with pytest.raises(InvalidInputError, match="private address"):
            files_module.download(f"{address}/first.m3u8", tmp_path)
        with pytest.raises(InvalidInputError, match="private address"):
            read_image(f"{address}/first.m3u8")
        assert not asked
        assert files_module.download(f"{address}/a.ts", tmp_path).read_bytes() == data


def test_public_addresses():
    assert all(map(web._is_public, ("8.8.8.8", "2606:4700:4700::1111")))
    ipv4 = ("127.0.0.1", "10.1.2.3", "100.64.0.1", "224.0.0.1", "0.0.0.0")
    ipv6 = ("::1", "fe80::1%eth0", "fd00::1", "::ffff:127.0.0.1")
    assert not [address for address in ipv4 + ipv6 if web._is_public(address)]
    assert not web._is_public("169.254.169.254"), "metadata of cloud machines"


def test_a_query_needs_no_path():
    with server(lambda _: (200, {}, b"")) as (address, paths):
        proxy = urlsplit(web.web_proxy(address))
        with socket.create_connection((proxy.hostname, proxy.port)) as client:
            client.sendall(f"GET {address}?clip=1 HTTP/1.1\r\nConnection: close\r\n\r\n".encode())
            assert b" 200 " in client.recv(100)
    assert paths == ["/?clip=1"]


def test_a_proxy_of_the_user_decides_itself(monkeypatch):
    assert web.web_proxy("https://example.org/a.mp4").startswith("http://127.0.0.1:")
    monkeypatch.setenv("HTTPS_PROXY", "http://proxy.example:3128")
    assert web.web_proxy("https://example.org/a.mp4") is None


def test_headers_that_drip_end_at_a_deadline(tmp_path, monkeypatch):
    def send_slowly(handler, name, value):
        with contextlib.suppress(ConnectionError):
            handler.wfile.write(f"{name}: {value}\r\n".encode())
        time.sleep(0.2)

    for module in (web, ffmpeg_module):
        monkeypatch.setattr(module, "NETWORK_DEADLINE", 1.0)
    monkeypatch.setattr(files_module, "_RETRY_DELAYS", ())
    monkeypatch.setattr(http.server.BaseHTTPRequestHandler, "send_header", send_slowly)
    headers = {f"X-{n}": n for n in range(100)}
    with server(lambda _: (200, headers, b"")) as (address, _):
        begun = time.monotonic()
        with pytest.raises(TransientVideoError):
            files_module.download(f"{address}/a.mp4", tmp_path)
        with pytest.raises(VideoError):
            open_source(f"{address}/a.mp4", reconnect=False)
        assert time.monotonic() - begun < 15


@pytest.fixture(params=MANIFESTS)
def manifest(request, tmp_path):
    """Bytes that name a video of somebody else."""
    private = write_clip(tmp_path / "private.ts", gray_frames(5))
    return MANIFESTS[request.param].format(f"file:{private}").encode()


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
