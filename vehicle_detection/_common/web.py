"""Access to web servers: files, limits of time, and the proxy through which servers are reached.

A server may redirect to another one, and a playlist names others. Without a check, whoever provides either
could read what only this machine can reach. The proxy connects to public addresses and to the server that the
URL names, and it ends connections of servers that send too little.
"""

from __future__ import annotations

import contextlib
import functools
import os
import select
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

from vehicle_detection._common.limits import Limit
from vehicle_detection._common.text import hide_credentials, is_web_address
from vehicle_detection.errors import InvalidInputError

NETWORK_TIMEOUT = 10.0
"""Seconds without data after which a server has failed."""
NETWORK_DEADLINE = 60.0
"""Seconds after which a server has failed that sends too little for a frame, or for the start of a video."""
MIN_RATE = 1000
"""Bytes per second below which a server has failed after `NETWORK_DEADLINE`."""
ALLOW_PRIVATE = "VEHICLE_DETECTION_ALLOW_PRIVATE"
"""Environment variable that, if set, allows all addresses."""
REFUSED = 421
"""Status of the answer in place of one from a private address."""

_CHUNK_BYTES, _PART_BYTES = 1 << 16, 1 << 20
_USER_PROXIES = {"http_proxy", "https_proxy", "all_proxy"}


def download_bytes(url: str, limit: Limit) -> bytes:
    """Return the content of a file of limited size at an ``http`` or ``https`` address."""
    from urllib3.exceptions import HTTPError

    name, data = hide_credentials(url), bytearray()
    if not is_web_address(url):
        raise InvalidInputError(f"URL {name} must begin with http:// or https://; download the file first")
    try:
        for chunk in read_http(url):
            data += chunk
            if len(data) > limit.current():
                raise InvalidInputError(limit.exceeded(f"URL {name}"))
    except FileNotFoundError:
        raise InvalidInputError(f"URL {name} does not exist; check the address") from None
    except (OSError, HTTPError) as error:
        reason = hide_credentials(str(error))
        raise InvalidInputError(f"URL {name} cannot be read ({reason}); check the address") from None
    return bytes(data)


def read_http(url: str) -> Iterator[bytes]:
    """Yield the parts of a file at a web address, which must not refer to private ones or be too slow."""
    import requests

    proxy = web_proxy(url)
    proxies = {"http": proxy, "https": proxy} if proxy else None
    with requests.get(url, stream=True, timeout=NETWORK_TIMEOUT, proxies=proxies) as answer:
        if answer.status_code == REFUSED and proxy:
            raise PermissionError(answer.reason)
        if answer.status_code in (404, 410):
            raise FileNotFoundError(url)
        answer.raise_for_status()
        begun, size = time.monotonic(), 0
        read = getattr(answer.raw, "read1", answer.raw.read)  # urllib3 before 2.2 lacks it
        while data := read(_PART_BYTES, decode_content=True):
            size += len(data)
            elapsed = time.monotonic() - begun
            if elapsed > NETWORK_DEADLINE and size < MIN_RATE * elapsed:
                raise TimeoutError(f"only {size} bytes in {elapsed:.0f} s")
            yield data


def web_proxy(url: str) -> str | None:
    """Return the URL of the proxy for a web address; None if the user has one, or allows all addresses."""
    if any(name.lower() in _USER_PROXIES and value for name, value in os.environ.items()):
        return None
    if os.environ.get(ALLOW_PRIVATE):
        return None
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise InvalidInputError(f"source is not a web address ({error}); check the URL") from None
    return f"http://127.0.0.1:{_start(host, port or (443 if parts.scheme == 'https' else 80), os.getpid())}"


@functools.cache
def _start(host: str, port: int, process: int) -> int:
    """Start the proxy of a server, once in each process, and return its port."""
    proxy = _Proxy(("127.0.0.1", 0), _Connection)
    proxy.server_named = host, port
    threading.Thread(target=proxy.serve_forever, name="web-proxy", daemon=True).start()
    return int(proxy.server_address[1])


class _Proxy(socketserver.ThreadingTCPServer):
    daemon_threads = True
    server_named: tuple[str, int]  # host and port of the URL

    def connect(self, host: str, port: int) -> socket.socket:
        """Connect to a server; a PermissionError if its address is neither public nor that of the URL."""
        found = _addresses(host)
        allowed = [address for address in found if _is_public(address)] or self._named(found, port)
        if not allowed:
            raise PermissionError(
                f"the server refers to {host} port {port}, a private address; open that, or set "
                f"{ALLOW_PRIVATE}=1"
            )
        for address in allowed[:-1]:  # localhost may be ::1, which is not that of every server
            with contextlib.suppress(OSError):
                return socket.create_connection((address, port), NETWORK_TIMEOUT)
        return socket.create_connection((allowed[-1], port), NETWORK_TIMEOUT)

    def _named(self, found: list[str], port: int) -> list[str]:
        """Return the addresses of the server that the URL names, which may redirect to HTTPS."""
        host, named = self.server_named
        if port != named and (named, port) != (80, 443):
            return []
        known = _addresses(host)
        return [address for address in found if address in known]


def _addresses(host: str) -> list[str]:
    return [str(found[4][0]) for found in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)]


def _is_public(address: str) -> bool:
    import ipaddress

    parsed = ipaddress.ip_address(address.partition("%")[0])
    inner = getattr(parsed, "ipv4_mapped", None) or parsed
    return inner.is_global and not inner.is_multicast


class _Connection(socketserver.BaseRequestHandler):
    """A request to the proxy: an HTTP request with a whole URL, or a tunnel for HTTPS."""

    server: _Proxy
    request: socket.socket

    def handle(self) -> None:
        """Connect to the server of the request, and pass on what both sides send."""
        self.request.settimeout(NETWORK_TIMEOUT)
        try:
            head = b""
            while b"\r\n\r\n" not in head and len(head) < _CHUNK_BYTES:
                head += self.request.recv(_CHUNK_BYTES) or b"\r\n\r\n"
            method, target, version = head.split(b"\r\n", 1)[0].decode("latin-1").split(" ", 2)
            place = urlsplit(target if "://" in target else f"//{target}")
            host, port = place.hostname or "", place.port or 80
        except (OSError, ValueError):
            return
        try:
            server = self.server.connect(host, port)
        except OSError as error:
            status = REFUSED if isinstance(error, PermissionError) and not error.errno else 502
            reason = error.strerror or str(error)
            self.request.sendall(f"HTTP/1.1 {status} {reason}\r\nContent-Length: 0\r\n\r\n".encode())
            return
        with server:
            if method == "CONNECT":
                self.request.sendall(b"HTTP/1.1 200 Connected\r\n\r\n")
            else:
                path = target.partition("://")[2][len(place.netloc) :]
                path = path if path.startswith("/") else f"/{path}"
                rest = head.split(b"\r\n", 1)[1]
                server.sendall(f"{method} {path} {version}\r\n".encode("latin-1") + rest)
            _relay(self.request, server)


def _relay(client: socket.socket, server: socket.socket) -> None:
    """Pass on data until one side ends, or the server sends too little for what it was asked."""
    client.settimeout(None)  # it may pause
    received, waited = 0, 0.0
    while waited < NETWORK_DEADLINE or received >= MIN_RATE * waited:
        begun = time.monotonic()
        ready, _, _ = select.select([client, server], [], [], NETWORK_TIMEOUT)
        waited += time.monotonic() - begun
        try:
            if client in ready:
                received, waited = 0, 0.0
                server.sendall(data := client.recv(_CHUNK_BYTES))
            if server in ready:
                client.sendall(data := server.recv(_CHUNK_BYTES))
                received += len(data)
            if ready and not data:
                return
        except OSError:
            return
