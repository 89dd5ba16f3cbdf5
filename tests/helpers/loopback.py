"""A server of files on the loopback interface, with the faults of real ones."""

import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Served:
    """A file, and how the server sends it."""

    content: bytes
    ranges: bool = True  # whether requests of the rest are answered
    version: str | None = '"1"'  # the ETag
    end: int | None = None  # the connection ends after so many bytes of the file
    stall: bool = False  # whether the connection stays open instead
    length: bool = True  # whether the length is stated


@dataclass
class Server:
    """The files of a running server, and the requests that it has received: path and Range."""

    address: str
    files: dict[str, Served] = field(default_factory=dict)
    requests: list[tuple[str, str | None]] = field(default_factory=list)


@contextmanager
def serve() -> Iterator[Server]:
    """Run a server until the end of the context."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requested = self.headers.get("Range")
            server.requests.append((self.path.removeprefix("/"), requested))
            served = server.files.get(self.path.removeprefix("/"))
            if served is None:
                self.send_error(404)
                return
            size = len(served.content)
            start = int(requested.removeprefix("bytes=").rstrip("-")) if requested and served.ranges else 0
            if start >= size > 0:
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{size}")
            else:
                self.send_response(206 if start else 200)
                if start:
                    self.send_header("Content-Range", f"bytes {start}-{size - 1}/{size}")
            if served.version is not None:
                self.send_header("ETag", served.version)
            body = b"" if start >= size else served.content[start:]
            if served.length:
                self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body if served.end is None else body[: max(0, served.end - start)])
            if served.stall:
                self.rfile.read(1)  # until the client ends

        def log_message(self, *_: object) -> None:
            pass

    running = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server = Server(f"http://127.0.0.1:{running.server_address[1]}/")
    thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        running.shutdown()
        running.server_close()
        thread.join()
