"""An object store in a folder, of which every third request fails, as a file system of fsspec.

The file system is registered for the protocol ``loopback`` in every process that finds `SITE` on its path.
"""

import hashlib
import itertools
import os
import tempfile
import threading
from pathlib import Path

from fsspec import AbstractFileSystem

SITE = """
import fsspec
fsspec.register_implementation("loopback", "tests.drive.object_store.LoopbackFileSystem", clobber=True)
"""
FOLDER = "VEHICLE_TEST_OBJECT_STORE"

_requests, _failed = itertools.count(1), set()


class LoopbackFileSystem(AbstractFileSystem):
    """Objects as files of the folder that the environment names."""

    protocol = "loopback"
    cachable = False

    @classmethod
    def _strip_protocol(cls, path):
        return super()._strip_protocol(path).rpartition("@")[2]

    @staticmethod
    def fails(request):
        """Whether a request fails: every third one, but not a thread's repetition of it."""
        if request in _failed:
            _failed.remove(request)
            return False
        if next(_requests) % 3 == 0:
            _failed.add(request)
            return True
        return False

    def _ask(self, command, path):
        """Return the path of an object, and its file."""
        path = self._strip_protocol(path)
        if self.fails((threading.get_ident(), command, path)):
            raise RuntimeError("the object store answers 503")  # as some libraries do: no OSError
        return path, Path(os.environ[FOLDER], path)

    def _list(self, path):
        """All objects below a path, by one request as in real stores."""
        path, place = self._ask("list", path)
        root, found = Path(os.environ[FOLDER]), {}
        for file in sorted(each for each in (place, *place.rglob("*")) if each.is_file()):
            name, data = file.relative_to(root).as_posix(), file.read_bytes()
            tag = hashlib.sha256(data).hexdigest()
            found[name] = {"name": name, "type": "file", "size": len(data), "ETag": tag}
        return path, found

    def find(self, path, maxdepth=None, withdirs=False, detail=False, **_):
        path, found = self._list(path)
        depth = float("inf") if maxdepth is None else maxdepth + path.count("/")
        found = {name: each for name, each in found.items() if name.count("/") <= depth}
        return found if detail else list(found)

    def ls(self, path, detail=True, **_):
        path, found = self._list(path)
        entries = {}
        for each in found:
            rest = each.removeprefix(f"{path}/")
            name = each.removesuffix(rest) + rest.partition("/")[0]
            entries[name] = found.get(name, {"name": name, "type": "directory", "size": 0})
        if not entries:
            raise FileNotFoundError(path)
        return list(entries.values()) if detail else list(entries)

    def cat_file(self, path, *_, **__):
        return self._ask("read", path)[1].read_bytes()

    def get_file(self, path, target, **_):
        Path(target).write_bytes(self.cat_file(path))

    def pipe_file(self, path, value, **_):
        """Store an object whole or not at all."""
        _, file = self._ask("write", path)
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=Path(os.environ[FOLDER]).parent, delete=False) as part:
            part.write(value)
        os.replace(part.name, file)

    def put_file(self, source, path, **_):
        self.pipe_file(path, Path(source).read_bytes())

    def rm_file(self, path):
        self._ask("remove", path)[1].unlink()
