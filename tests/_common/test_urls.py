"""URLs: what is secret in them, and what stays the same when they are signed again."""

import pytest

from vehicle_detection._common import hide_credentials, local_path, stable_url

HOST = "https://bucket.example/cards/a.mp4"
S3 = "?X-Amz-Algorithm=AWS4&X-Amz-Credential=AKIA%2F2026&X-Amz-Date=20260131T081500Z&X-Amz-Signature=ab12"
AZURE = "?sv=2024-01-01&se=2026-02-01&sr=b&sp=r&sig=a%2Fb%3D"
CLOUDFRONT = "?Expires=1769847300&Signature=ab~12__&Key-Pair-Id=K2J&Policy=eyJ"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://anna:pa@ss@cam/stream", "rtsp://***@cam/stream"),
        (f"{HOST}?token=ab.c-d", f"{HOST}?token=***"),
        (f"(403 for url: {HOST}?part=1&access_token=abc)", f"(403 for url: {HOST}?part=1&access_token=***)"),
        (f"'{HOST}?sig=a/b=='; check", f"'{HOST}?sig=***'; check"),
        ("/a.mp4?X-Amz-Security-Token=abc&n=2", "/a.mp4?X-Amz-Security-Token=***&n=2"),
        (f"{HOST}?camera=front&page=2", f"{HOST}?camera=front&page=2"),
        (f"{HOST}?monkey=3&keyframe=4", f"{HOST}?monkey=3&keyframe=4"),
        ("a drive at 5:00 @ home", "a drive at 5:00 @ home"),
        ("http://cam/v.cgi?loginuse=anna&loginpas=word", "http://cam/v.cgi?loginuse=***&loginpas=***"),
        ("http://cam/v?psw=word&ch=1", "http://cam/v?psw=***&ch=1"),
        ("http://cam/v?sid=word; check", "http://cam/v?sid=***; check"),
        ("http://cam/v?hdnts=exp=1~hmac=word", "http://cam/v?hdnts=***"),
        ("http://cam/v?pw=wo#rd", "http://cam/v?pw=***"),
        ("http://cam/v?page=2#access_token=word", "http://cam/v?page=2#access_token=***"),
        ("http://anna:pa#s/s@cam:80/x", "http://***@cam:80/x"),
        ("rtsp://anna:my word@cam/x: refused", "rtsp://***@cam/x: refused"),
        ("http://anna:12/34@cam/x", "http://***@cam/x"),
        ("srt://cam:9000?passphrase=word&mode=caller", "srt://cam:9000?passphrase=***&mode=caller"),
        ("http://a:1@b/x, http://c:2@d/y", "http://***@b/x, http://***@d/y"),
        ("http://cam:8080/x failed at 5 @ home", "http://cam:8080/x failed at 5 @ home"),
        (
            "rtsp://cam/user=anna_password=a_word_channel=1.sdp",
            "rtsp://cam/user=***_password=***_channel=1.sdp",
        ),
        ("s3://fleet/date=2026-01-31/camera=front/a.mp4", "s3://fleet/date=2026-01-31/camera=front/a.mp4"),
    ],
)
def test_secrets_are_hidden(text, shown):
    assert hide_credentials(text) == shown
    assert hide_credentials(shown) == shown


@pytest.mark.parametrize("query", [S3, AZURE, CLOUDFRONT])
def test_signed_urls(query):
    shown = hide_credentials(f"{HOST}{query}")
    for secret in ("AKIA", "ab12", "ab~12", "a%2Fb", "K2J", "eyJ"):
        assert secret not in shown
    assert stable_url(f"{HOST}{query}") == HOST
    assert stable_url(f"{HOST}{query}&versionId=3#t=5") == f"{HOST}?versionId=3#t=5"


def test_parameters_that_may_name_a_file_are_kept():
    """Else two files would be one."""
    for query in ("?token=a", "?key=a.mp4", "?se=3&file=b", "?file=a.mp4&api_key=c"):
        assert stable_url(f"{HOST}{query}") == f"{HOST}{query}"
    assert stable_url("s3://bucket/a.mp4") == "s3://bucket/a.mp4"
    assert stable_url("https://anna:pa@ss@nas/a.mp4") == "https://anna@nas/a.mp4"


def test_paths_of_file_urls():
    assert local_path("file:///a%20b/c.mp4") == local_path("FILE:///a%20b/c.mp4") == "/a b/c.mp4"
    assert local_path("file://localhost/a%20b/c.mp4") == "/a b/c.mp4"
    assert local_path("http://host/a%20b") == "http://host/a%20b"
    assert local_path("a%20b.mp4") == "a%20b.mp4"
