"""A model hub on this machine that answers what huggingface_hub's client asks when it pushes and pulls."""

import base64
import hashlib
import json

from local_server import LocalHandler, LocalServer

TOKEN = "hf_local"


class HubServer(LocalServer):
    """Repositories are dictionaries of files; those named in `private` need the token to read, too."""

    def __init__(self) -> None:
        super().__init__(_Handler)
        self.repositories: dict[str, dict[str, bytes]] = {}
        self.private: set[str] = set()
        self.large: dict[str, bytes] = {}  # by SHA-256, on their way to a commit
        self.commits = 0


class _Handler(LocalHandler):
    server: HubServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path.startswith("/api/models/"):
            name = "/".join(path.split("/")[3:5])
            if (files := self._readable(name)) is not None:
                siblings = [{"rfilename": file} for file in sorted(files)]
                self._answer({"id": name, "sha": self._commit, "siblings": siblings})
            return
        if "/resolve/" not in path:  # what the client asks beside, such as news of itself
            self.send(404, b"")
            return
        owner, name, _, _, file = path[1:].split("/", 4)
        if (files := self._readable(f"{owner}/{name}")) is not None:
            self.send(200, files[file], {"ETag": hashlib.sha256(files[file]).hexdigest()})

    do_HEAD = do_GET

    def do_PUT(self) -> None:
        content = self._body()
        self.server.large[hashlib.sha256(content).hexdigest()] = content
        self.send(200, b"")

    def do_POST(self) -> None:
        body, path = self._body(), self.path.partition("?")[0]
        if not self._authorised():
            self._answer({"error": "Invalid username or password."}, 401)
        elif path == "/api/repos/create":
            self._create(json.loads(body))
        elif path.endswith("/preupload/main"):
            self._answer({"files": [_mode(file["path"]) for file in json.loads(body)["files"]]})
        elif path.endswith("/info/lfs/objects/batch"):
            objects = [
                item | {"actions": {"upload": {"href": f"{self.server.url}/lfs/{item['oid']}"}}}
                for item in json.loads(body)["objects"]
            ]
            self._answer({"transfer": "basic", "objects": objects})
        elif path.endswith("/commit/main"):
            name = "/".join(path.split("/")[3:5])
            self._apply(self.server.repositories[name], body)
            url = f"{self.server.url}/{name}/commit/{self._commit}"
            self._answer({"commitUrl": url, "commitOid": self._commit, "success": True})
        elif path == "/api/validate-yaml":  # of the card
            self._answer({"errors": [], "warnings": []})
        else:
            self.send(404, b"")

    def _create(self, wanted: dict) -> None:
        name = f"{wanted['organization']}/{wanted['name']}"
        status = 409 if name in self.server.repositories else 200
        self.server.repositories.setdefault(name, {".gitattributes": b""})
        if wanted.get("visibility") == "private":
            self.server.private.add(name)
        self._answer({"url": f"{self.server.url}/{name}", "id": name}, status)

    def _apply(self, files: dict[str, bytes], body: bytes) -> None:
        for line in map(json.loads, body.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.server.large[value["oid"]]
            elif line["key"] == "deletedFile":
                del files[value["path"]]
        self.server.commits += 1

    @property
    def _commit(self) -> str:
        return f"{self.server.commits:040x}"

    def _authorised(self) -> bool:
        return self.headers["Authorization"] == f"Bearer {TOKEN}"

    def _readable(self, name: str) -> dict[str, bytes] | None:
        """The files, or None after an answer that says why not, as the Hub's."""
        files = self.server.repositories.get(name)
        if files is None or (name in self.server.private and not self._authorised()):
            self.send(404, b"{}", {"X-Error-Code": "RepoNotFound"})
            return None
        return files

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers["Content-Length"] or 0))

    def _answer(self, value: dict, status: int = 200) -> None:
        self.send(status, json.dumps(value).encode(), {"Content-Type": "application/json"})

    def send(self, status: int, content: bytes, headers: dict[str, str] | None = None) -> None:
        super().send(status, content, {"X-Repo-Commit": self._commit, **(headers or {})})


def _mode(path: str) -> dict[str, object]:
    large = path.endswith(".safetensors")
    return {"path": path, "uploadMode": "lfs" if large else "regular", "shouldIgnore": False}
