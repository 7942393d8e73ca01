"""A server on this machine that answers what an S3 client asks when it lists and reads."""

from datetime import UTC, datetime
from email.utils import formatdate
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

from local_server import LocalHandler, LocalServer


class S3Server(LocalServer):
    """Buckets are the folders of `root`; `read` lists the files that were fetched, in order."""

    def __init__(self, root: Path) -> None:
        super().__init__(_Handler)
        self.root, self.read = root, list[str]()


class _Handler(LocalHandler):
    server: S3Server  # pyright: ignore[reportIncompatibleVariableOverride]  # its only server

    def do_GET(self) -> None:
        address = urlsplit(self.path)
        bucket, _, key = unquote(address.path).strip("/").partition("/")
        if not (self.server.root / bucket).is_dir():
            self.send(404, _error("NoSuchBucket", "The specified bucket does not exist"))
        elif "list-type=2" in address.query:
            asked = parse_qs(address.query)
            self._list(bucket, *(asked.get(name, [""])[0] for name in ("prefix", "delimiter")))
        elif (path := self.server.root / bucket / key).is_file():
            if self.command == "GET":
                self.server.read.append(key)
            self._send_file(path)
        else:
            self.send(404, _error("NoSuchKey", "The specified key does not exist"))

    do_HEAD = do_GET

    def _list(self, bucket: str, prefix: str, delimiter: str) -> None:
        folder = self.server.root / bucket
        names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
        inside = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
        folders = {name.partition("/")[0] for name in inside if "/" in name} if delimiter else ()
        names = [name for name in names if not (delimiter and "/" in name.removeprefix(prefix))]
        rows = "".join(
            f"<CommonPrefixes><Prefix>{escape(prefix + name)}/</Prefix></CommonPrefixes>"
            for name in sorted(folders)
        )
        rows += "".join(
            f"<Contents><Key>{escape(name)}</Key><LastModified>{_iso(folder / name)}</LastModified>"
            f"<ETag>x</ETag><Size>{(folder / name).stat().st_size}</Size></Contents>"
            for name in names
            if name.startswith(prefix)
        )
        head = f"<Name>{bucket}</Name><Prefix>{escape(prefix)}</Prefix><IsTruncated>false</IsTruncated>"
        self.send(200, f"<ListBucketResult>{head}{rows}</ListBucketResult>".encode())

    def _send_file(self, path: Path) -> None:
        data = path.read_bytes()
        first, _, last = self.headers.get("Range", "bytes=0-").removeprefix("bytes=").partition("-")
        part = data[int(first) : int(last or len(data)) + 1]
        there = f"bytes {first}-{int(first) + len(part) - 1}/{len(data)}"
        modified = formatdate(path.stat().st_mtime, usegmt=True)
        headers = {"Content-Range": there, "Last-Modified": modified}
        self.send(206 if "Range" in self.headers else 200, part, headers)


def _iso(path: Path) -> str:
    seconds = int(path.stat().st_mtime)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.000Z"


def _error(code: str, message: str) -> bytes:
    return f"<Error><Code>{code}</Code><Message>{message}</Message></Error>".encode()
