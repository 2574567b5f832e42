"""A stand-in of the Hugging Face Hub on this machine: the requests of huggingface_hub for making a
repository, one commit of regular and LFS files, and downloads."""

import base64
import hashlib
import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKEN = "hf_stand_in"
COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub(BaseHTTPRequestHandler):
    """Repositories are ``{name: {path: content}}`` of the server."""

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path)
        if found := re.fullmatch(r"/api/models/(\w+/[\w.-]+)(/.+)?", path):
            self._about(*found.groups())
        elif found := re.fullmatch(r"/(\w+/[\w.-]+)/resolve/(\w+)/(.+)", path):
            name, _, file = found.groups()
            self._file(self.server.repositories.get(name, {}).get(file))
        else:
            self._json({"error": f"no {path}"}, 404)

    do_HEAD = do_GET

    def do_POST(self) -> None:
        path = urlsplit(self.path).path
        sent = self.rfile.read(int(self.headers["Content-Length"]))
        lines = [json.loads(line) for line in sent.splitlines()]
        if path == "/api/validate-yaml":
            self.server.cards.append(lines[0]["content"])
            self._json({"warnings": [], "errors": []})
        elif self.headers.get("Authorization") != f"Bearer {TOKEN}":
            self._json({"error": "Invalid username or password."}, 401)
        elif path == "/api/repos/create":
            name = f"{lines[0]['organization']}/{lines[0]['name']}"
            self.server.repositories.setdefault(name, {})
            self.server.created.append(lines[0])
            self._json({"url": f"{self.server.address}/{name}"})
        elif found := re.match(r"/api/models/(.+)/preupload/main$", path):
            modes = [self._mode(file["path"]) for file in lines[0]["files"]]
            self._json({"files": modes})
        elif path.endswith(".git/info/lfs/objects/batch"):
            actions = [self._upload(file) for file in lines[0]["objects"]]
            self._json({"transfer": "basic", "objects": actions})
        elif found := re.match(r"/api/models/(.+)/commit/main$", path):
            self._commit(self.server.repositories[found[1]], lines)
            url = f"{self.server.address}/{found[1]}/commit/{COMMIT}"
            self._json({"commitUrl": url, "commitOid": COMMIT})
        else:
            self._json({"error": f"no {path}"}, 404)

    def do_PUT(self) -> None:
        content = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.objects[self.path.rpartition("/")[2]] = content
        self._answer(b"", 200, {})

    def _about(self, name: str, what: str | None) -> None:
        """The state of a repository, or the list of its files."""
        if name not in self.server.repositories:
            # The Hub does not tell whether a private repository exists.
            headers = {"X-Error-Code": "RepoNotFound"}
            self._answer(b"{}", 401, headers)
        elif what and what.startswith("/tree/"):
            files = self.server.repositories[name]
            entries = [
                {"type": "file", "path": path, "size": len(x), "oid": sha(x)}
                for path, x in files.items()
            ]
            self._json(entries)
        else:
            self._json({"id": name, "sha": COMMIT, "siblings": []})

    def _file(self, content: bytes | None) -> None:
        if content is None:
            self._answer(b"", 404, {"X-Error-Code": "EntryNotFound"})
        else:
            headers = {"ETag": f'"{sha(content)}"', "X-Repo-Commit": COMMIT}
            self._answer(content, 200, headers)

    def _mode(self, path: str) -> dict:
        large = path.endswith(".safetensors")
        mode = "lfs" if large else "regular"
        return {"path": path, "uploadMode": mode, "shouldIgnore": False}

    def _upload(self, file: dict) -> dict:
        href = f"{self.server.address}/objects/{file['oid']}"
        return {**file, "actions": {"upload": {"href": href}}}

    def _commit(self, files: dict[str, bytes], lines: list[dict]) -> None:
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.server.objects[value["oid"]]

    def _json(self, content: object, status: int = 200) -> None:
        headers = {"Content-Type": "application/json"}
        self._answer(json.dumps(content).encode(), status, headers)

    def _answer(self, body: bytes, status: int, headers: dict) -> None:
        self.send_response(status)
        for key, value in headers.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing is logged."""


def sha(content: bytes) -> str:
    return hashlib.sha1(content).hexdigest()


@contextmanager
def hub_server():
    """The running server; its address is for HF_ENDPOINT."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    server.address = f"http://127.0.0.1:{server.server_port}"
    server.repositories = {}
    server.objects = {}
    server.created = []
    server.cards = []
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
