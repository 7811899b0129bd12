import io
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.datasets.cases import OTHERS, VEHICLES, png, write_zip
from tests.helpers import FULL_DISK, answer, serve
from vehicle_detection._common import natural_key
from vehicle_detection.datasets import archives, fetch_patches, load_training_patches
from vehicle_detection.errors import DatasetError, InvalidInputError, OutputError

# Natural order


@given(st.lists(st.integers(0, 10**30), min_size=1))
def test_natural_order_is_the_order_of_the_numbers(numbers):
    names = [f"vehicles/GTI/image{number}.png" for number in numbers]
    ordered = sorted(names, key=natural_key)
    assert ordered == [f"vehicles/GTI/image{number}.png" for number in sorted(numbers)]


# Downloads from a local server


class Answers:
    """Answers each path with a body and the length that it claims to have."""

    def __init__(self):
        self.answers, self.requests = {}, []

    def put(self, name, body, length=None):
        self.answers[f"/data/{name}"] = (body, len(body) if length is None else length)

    def handle(self, request):
        self.requests.append(request.path)
        if request.path in self.answers:
            body, length = self.answers[request.path]
            answer(request, 200, body, {"Content-Length": length})
        else:
            answer(request, 404)


def zip_bytes(members):
    buffer = io.BytesIO()
    write_zip(buffer, members)
    return buffer.getvalue()


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    counts = {
        "vehicles.zip": {"vehicles/GTI_Far": 2, "vehicles/KITTI_extracted": 1},
        "non-vehicles.zip": {"non-vehicles/Extras": 1, "non-vehicles/GTI": 1},
    }
    monkeypatch.setattr(archives, "ARCHIVES", counts)
    answers = Answers()
    answers.put("vehicles.zip", zip_bytes(VEHICLES))
    answers.put("non-vehicles.zip", zip_bytes(OTHERS))
    with serve(answers.handle) as address:
        answers.url = f"{address}/data"
        yield answers


def test_both_archives_are_downloaded_once(server, tmp_path, capsys):
    folder = tmp_path / "new" / "cache"
    paths = fetch_patches(folder, url=server.url, progress=False)
    assert paths == (folder / "vehicles.zip", folder / "non-vehicles.zip")
    counts = {"Extras": 1, "GTI": 1, "GTI_Far": 2, "KITTI_extracted": 1}
    assert load_training_patches(*paths).counts() == counts
    assert sorted(os.listdir(folder)) == ["non-vehicles.zip", "vehicles.zip"]
    assert server.requests == ["/data/vehicles.zip", "/data/non-vehicles.zip"]
    assert fetch_patches(folder, url=f"{server.url}/", progress=False) == paths
    assert len(server.requests) == 2
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""


def test_a_damaged_existing_archive_is_downloaded_again(server, tmp_path, caplog):
    (tmp_path / "vehicles.zip").write_bytes(zip_bytes(VEHICLES).replace(b"IDAT", b"iDAT"))
    fetch_patches(tmp_path, url=server.url, progress=False)
    assert (tmp_path / "vehicles.zip").read_bytes() == server.answers["/data/vehicles.zip"][0]
    assert "is damaged at 'vehicles/GTI_Far/image10.png'" in caplog.text


def test_the_default_folder_is_the_user_cache(server, tmp_path, monkeypatch):
    monkeypatch.setattr("pooch.os_cache", lambda project: tmp_path / project)
    vehicles, _ = fetch_patches(url=server.url, progress=False)
    assert vehicles == tmp_path / "vehicle_detection" / "vehicles.zip"


def with_member(name, data=b""):
    return zip_bytes({**OTHERS, name: data})


WHOLE = zip_bytes(OTHERS)
BROKEN = {
    "cut": (WHOLE[:-300], "cannot be downloaded completely"),
    "short": (WHOLE[:-300], "is a damaged or incomplete zip; download it again"),
    "page": (b"\n<!DOCTYPE html><html>sign in</html>", "is a web page, not a zip"),
    "empty": (b"", "is not a zip"),
    "member": (with_member("non-vehicles/GTI/a.exe"), "holds 'non-vehicles/GTI/a.exe', which is not a patch"),
    "folder": (with_member("vehicles/GTI_Far/1.png"), "holds 'vehicles/GTI_Far/1.png', which is not a patch"),
    "parent": (with_member("../evil.png"), r"holds '\.\./evil.png', which is not"),
    "hidden": (with_member("non-vehicles/../../.rc"), r"holds 'non-vehicles/../../.rc', which is not"),
    "too few": (zip_bytes({"non-vehicles/GTI/1.png": png(1)}), "holds 0 patches in non-vehicles/Extras, exp"),
    "too many": (with_member("non-vehicles/GTI/2.png", png(1)), "holds 2 patches in non-vehicles/GTI, exp"),
    "damaged": (WHOLE.replace(b"IDAT", b"iDAT"), "is damaged at 'non-vehicles/Extras/extra1.png'; download"),
    "missing": (None, "non-vehicles.zip returns 404; pass the url of a folder with"),
}


@pytest.mark.parametrize("case", BROKEN)
@pytest.mark.parametrize("earlier", [False, True])
def test_a_failed_download_changes_no_file(server, tmp_path, case, earlier, caplog):
    body, message = BROKEN[case]
    if earlier:
        (tmp_path / "non-vehicles.zip").write_bytes(b"an earlier file")
    if body is None:
        del server.answers["/data/non-vehicles.zip"]
    else:
        server.put("non-vehicles.zip", body, len(WHOLE) if case == "cut" else None)
    with pytest.raises(DatasetError, match=message) as caught:
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert str(caught.value).startswith(f"{server.url}/non-vehicles.zip ")
    assert "\n" not in str(caught.value)
    assert sorted(os.listdir(tmp_path)) == ["non-vehicles.zip", "vehicles.zip"][not earlier :]
    if earlier:
        assert (tmp_path / "non-vehicles.zip").read_bytes() == b"an earlier file"
        assert "the existing file is not the archive" in caplog.text

    server.put("non-vehicles.zip", zip_bytes(OTHERS))
    vehicles, others = fetch_patches(tmp_path, url=server.url, progress=False)
    assert len(load_training_patches(vehicles, others)) == 5
    assert server.requests.count("/data/vehicles.zip") == 1


def test_an_unreachable_server(server, tmp_path):
    with serve(server.handle) as url:
        pass
    with pytest.raises(DatasetError, match=r"vehicles.zip .*\(ConnectionError\); check the network"):
        fetch_patches(tmp_path, url=url, progress=False)
    assert os.listdir(tmp_path) == []


def test_an_invalid_address(tmp_path):
    with pytest.raises(InvalidInputError, match=r"url must start with http:// or https://; got 'data'"):
        fetch_patches(tmp_path, url="data")
    with pytest.raises(DatasetError, match=r"cannot be downloaded .*\(InvalidURL\)"):
        fetch_patches(tmp_path, url="http://", progress=False)


def test_the_folder_must_be_writable(server, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInputError, match=r"folder .*file cannot be created: .*choose another"):
        fetch_patches(tmp_path / "file", url=server.url, progress=False)
    assert server.requests == []
    monkeypatch.setattr(os, "access", lambda *args: False)
    with pytest.raises(InvalidInputError, match=r"target needs a .*folder, .* is read-only; choose another"):
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert server.requests == []


def test_verified_archives_in_a_read_only_folder_are_used(server, tmp_path, monkeypatch):
    fetch_patches(tmp_path, url=server.url, progress=False)
    monkeypatch.setattr(os, "access", lambda *args: False)
    fetch_patches(tmp_path, url=server.url, progress=False)
    assert len(server.requests) == 2


def test_a_full_disk(server, tmp_path, monkeypatch):
    monkeypatch.setattr("pooch.HTTPDownloader.__call__", FULL_DISK)
    with pytest.raises(OutputError, match=r"vehicles.zip cannot be written \(No space .*; free some space"):
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert os.listdir(tmp_path) == []


def test_an_interrupt_removes_the_partial_file(server, tmp_path, monkeypatch):
    def interrupt(self, address, file, pooch):
        Path(file).write_bytes(b"PK")
        raise KeyboardInterrupt

    monkeypatch.setattr("pooch.HTTPDownloader.__call__", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fetch_patches(tmp_path, url=server.url, progress=False)
    assert os.listdir(tmp_path) == []


@pytest.mark.realdata
def test_the_real_archives_verify_without_a_request(real_data):
    paths = fetch_patches(real_data, url="http://127.0.0.1:1")
    assert paths == (real_data / "vehicles.zip", real_data / "non-vehicles.zip")
