"""An object store on the loopback interface, of which every third request fails, and its fsspec file system.

The file system is registered for the protocol ``loopback`` in every process that finds `SITE` on its path.
"""

import contextlib
import hashlib
import http.client
import http.server
import json
import os
import threading
from urllib.parse import quote, unquote

from fsspec import AbstractFileSystem

SITE = """
import fsspec
fsspec.register_implementation("loopback", "tests.drive.object_store.LoopbackFileSystem", clobber=True)
"""
PORT = "VEHICLE_TEST_OBJECT_STORE"


class ObjectStore(http.server.ThreadingHTTPServer):
    """Objects by key; `requests` counts all requests, of which every third is answered with 503.

    A thread's repetition of a failed request is answered: otherwise a request of one of several threads could
    fail by chance as often as it is tried.
    """

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.objects, self.requests, self.written = {}, 0, []
        self.failed = {}
        self.lock = threading.Lock()

    def fails(self, client, request):
        with self.lock:
            self.requests += 1
            repeated = self.failed.pop(client, None) == request
            fails = self.requests % 3 == 0 and not repeated
            if fails:
                self.failed[client] = request
            return fails


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def handle_request(self):
        length = int(self.headers.get("Content-Length", 0))
        body = self.rfile.read(length)
        if len(body) < length:  # the client has ended: an object is stored whole or not at all
            return None
        key, objects = unquote(self.path[1:]), self.server.objects
        if self.server.fails(self.headers["From"], (self.command, self.path)):
            return self.answer(503)
        if self.command == "PUT":
            objects[key] = body
            self.server.written.append(key)
        elif key.startswith("?"):
            found = [each for each in sorted(objects) if each.startswith(key[1:])]
            return self.answer(200, json.dumps([facts(each, objects[each]) for each in found]).encode())
        elif key not in objects:
            return self.answer(404)
        elif self.command == "DELETE":
            del objects[key]
        else:
            return self.answer(200, objects[key])
        return self.answer(200)

    do_GET = do_PUT = do_DELETE = handle_request  # noqa: N815

    def answer(self, code, body=b""):
        self.send_response(code)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


def facts(key, data):
    return {"name": key, "type": "file", "size": len(data), "ETag": hashlib.sha256(data).hexdigest()}


class LoopbackFileSystem(AbstractFileSystem):
    """Files of an `ObjectStore` whose port is in the environment."""

    protocol = "loopback"
    cachable = False

    @classmethod
    def _strip_protocol(cls, path):
        return super()._strip_protocol(path).rpartition("@")[2]

    def _ask(self, command, path, data=None):
        connection = http.client.HTTPConnection("127.0.0.1", int(os.environ[PORT]), timeout=60)
        with contextlib.closing(connection):
            client = {"From": f"{os.getpid()} {threading.get_ident()}"}
            connection.request(command, "/" + quote(path), data, client)
            answer = connection.getresponse()
            body = answer.read()
        if answer.status == 404:
            raise FileNotFoundError(path)
        if answer.status != 200:
            raise RuntimeError(
                f"the object store answers {answer.status}"
            )  # as some libraries do: no OSError
        return body

    def _list(self, path):
        """All objects below a path, by one request as in real stores."""
        path = self._strip_protocol(path)
        found = json.loads(self._ask("GET", f"?{path}"))
        return path, [each for each in found if each["name"] == path or each["name"].startswith(f"{path}/")]

    def find(self, path, maxdepth=None, withdirs=False, detail=False, **_):
        path, found = self._list(path)
        depth = float("inf") if maxdepth is None else maxdepth + path.count("/")
        found = {each["name"]: each for each in found if each["name"].count("/") <= depth}
        return found if detail else sorted(found)

    def ls(self, path, detail=True, **_):
        path, found = self._list(path)
        entries = {}
        for each in found:
            rest = each["name"].removeprefix(f"{path}/")
            name = each["name"].removesuffix(rest) + rest.partition("/")[0]
            entries[name] = each if name == each["name"] else {"name": name, "type": "directory", "size": 0}
        if not entries:
            raise FileNotFoundError(path)
        return list(entries.values()) if detail else list(entries)

    def cat_file(self, path, **_):
        return self._ask("GET", self._strip_protocol(path))

    def get_file(self, path, target, **_):
        data = self.cat_file(path)
        with open(target, "wb") as file:
            file.write(data)

    def pipe_file(self, path, value, **_):
        self._ask("PUT", self._strip_protocol(path), value)

    def put_file(self, source, path, **_):
        with open(source, "rb") as file:
            self.pipe_file(path, file.read())

    def rm_file(self, path):
        self._ask("DELETE", self._strip_protocol(path))
