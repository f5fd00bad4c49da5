"""An HTTP server on this machine that writes down what it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

# serves /whole.tif, an /x.mrf that writes to `victim`, and of /short.tif the beginning, whereupon
# the connection is cut
SERVER = """
import http.server, os, sys
FILES = {
    "/whole.tif": open(sys.argv[2], "rb").read(),
    "/x.mrf": b"<MRF_META><Raster><Size x='64' y='64' c='1'/><Compression>NONE</Compression>"
    b"<DataType>Byte</DataType><DataFile>" + os.fsencode(os.path.dirname(sys.argv[1]))
    + b"/victim</DataFile></Raster><CachedSource><Source>/whole.tif</Source></CachedSource>"
    b"</MRF_META>",
}
class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        with open(sys.argv[1], "a") as log:
            log.write(self.path + "\\n")
        data = open(sys.argv[2], "rb").read()
        if self.path == "/short.tif" and self.headers.get("Range"):
            start, _, end = self.headers["Range"].partition("=")[2].partition("-")
            start, end = int(start), min(int(end), len(data) - 1)
            if start > 0:
                return
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{end}/{len(data)}")
            self.send_header("Content-Length", str(end + 1 - start))
            self.end_headers()
            self.wfile.write(data[start:end + 1])
        elif self.path in FILES:
            file = FILES[self.path]
            start, _, end = self.headers.get("Range", "=0-").partition("=")[2].partition("-")
            part = file[int(start):min(int(end or len(file)), len(file) - 1) + 1]
            self.send_response(206 if "Range" in self.headers else 200)
            if "Range" in self.headers:
                last = int(start) + len(part) - 1
                self.send_header("Content-Range", f"bytes {start}-{last}/{len(file)}")
            self.send_header("Content-Length", str(len(part)))
            self.send_header("Accept-Ranges", "bytes")
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(part)
        elif self.path == "/short.tif":
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Accept-Ranges", "bytes")
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(data[:20_000])
        else:
            self.send_response(404)
            self.end_headers()
    do_HEAD = do_GET
    def log_message(self, *args):
        pass
server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
print(server.server_port, flush=True)
server.serve_forever()
"""


@dataclass
class Server:
    """An HTTP server in a process of its own: GDAL may hold the lock of this one."""

    address: str
    log: Path

    @property
    def requests(self) -> list[str]:
        return self.log.read_text().split() if self.log.exists() else []
