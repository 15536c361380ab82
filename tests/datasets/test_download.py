"""Downloads from a server on this machine that fails, stalls, truncates and lies."""

import io
import tarfile
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from gavo_jax.cli import main
from gavo_jax.datasets import download as module
from gavo_jax.datasets.download import download, folder_of
from gavo_jax.errors import GavoError
from gavo_jax.locks import hold

FOLDER = "rgbd_dataset_freiburg1_xyz"
LIST = b"# color images\n" + b"".join(b"%d.0 rgb/%d.png\n" % (i, i * 7919) for i in range(9000))


def archive(*extra: tarfile.TarInfo, folder: str = FOLDER) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", compresslevel=1) as tar:
        member = tarfile.TarInfo(f"{folder}/rgb.txt")
        member.size = len(LIST)
        tar.addfile(member, io.BytesIO(LIST))
        for member in extra:
            tar.addfile(member, io.BytesIO(b"x" * member.size))
    return buffer.getvalue()


def member(name: str, kind: bytes = tarfile.REGTYPE, target: str = "") -> tarfile.TarInfo:
    found = tarfile.TarInfo(name)
    found.type, found.linkname = kind, target
    return found


class Server(ThreadingHTTPServer):
    """Serves `content`; each request takes one fault from the front of `faults`."""

    content = archive()
    faults: list[str]
    ranges = True
    length = ""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.faults, self.requests = [], []
        self.released = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}/dataset"


class Handler(BaseHTTPRequestHandler):
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        server, content = self.server, self.server.content
        asked = self.headers.get("Range")
        server.requests.append((self.path, asked))
        fault = server.faults.pop(0) if server.faults else ""
        if fault.isdecimal():
            self.send_error(int(fault))
            return
        start = int(asked.removeprefix("bytes=").rstrip("-")) if asked and server.ranges else 0
        if start >= len(content):
            self.send_error(416)
            return
        self.send_response(206 if asked and server.ranges else 200)
        if asked and server.ranges:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        self.send_header("Content-Length", server.length or str(len(content) - start))
        self.end_headers()
        body = content[start:]
        self.wfile.write(body[: len(body) // 2] if fault else body)
        self.wfile.flush()
        if fault == "stall":
            server.released.wait(20)
        self.close_connection = True


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(module, "PAUSE", 0.0)
    monkeypatch.setattr(module, "TIMEOUT", (2.0, 0.3))
    monkeypatch.setattr(module, "CHUNK", 1000)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield server
        server.released.set()
        server.shutdown()


def is_whole(folder: Path, to: Path) -> bool:
    return (folder / "rgb.txt").read_bytes() == LIST and [path.name for path in to.iterdir()] == [FOLDER]


@pytest.mark.parametrize("name", ["fr1_xyz", "freiburg1_xyz", FOLDER])
def test_names(name: str):
    assert folder_of(name) == FOLDER


def test_nearest_name_is_offered():
    with pytest.raises(GavoError, match="did you mean 'fr2_desk'"):
        folder_of("fr2_dsk")


def test_command(server: Server, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("GAVO_TUM_SERVER", server.url)
    assert main(["download", "fr1_xyz", "--to", str(tmp_path / "data")]) == 0
    assert server.requests == [(f"/dataset/freiburg1/{FOLDER}.tgz", None)]
    assert is_whole(tmp_path / "data" / FOLDER, tmp_path / "data")
    assert capsys.readouterr().out.strip() == str(tmp_path / "data" / FOLDER)
    assert main(["download", "fr1_xyz", "--to", str(tmp_path / "data")]) == 0 and len(server.requests) == 1


def test_no_network_is_one_line(tmp_path: Path, monkeypatch, capsys, server: Server):
    monkeypatch.setenv("GAVO_TUM_SERVER", "http://127.0.0.1:9/dataset")
    assert main(["download", "fr1_xyz", "--to", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "no connection" in error and "127.0.0.1:9" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("fault", ["truncate", "stall"])
def test_resumes_where_it_broke_off(server: Server, tmp_path: Path, fault: str):
    server.faults = [fault, fault]
    seen: list[tuple[int, int | None]] = []
    assert is_whole(download("fr1_xyz", tmp_path, server.url, lambda *now: seen.append(now)), tmp_path)
    starts = [int(asked.removeprefix("bytes=").rstrip("-")) for _, asked in server.requests[1:]]
    assert len(starts) == 2 and 0 < starts[0] < starts[1] < len(server.content)
    assert seen[-1] == (len(server.content), len(server.content)) and seen == sorted(seen)


def test_starts_again_where_the_server_cannot_resume(server: Server, tmp_path: Path):
    server.faults, server.ranges = ["truncate"], False
    assert is_whole(download("fr1_xyz", tmp_path, server.url), tmp_path)


def test_a_second_call_goes_on(server: Server, tmp_path: Path):
    server.faults = ["truncate"] * module.ATTEMPTS
    with pytest.raises(GavoError, match=rf"broke off {module.ATTEMPTS} times: .*keeps what was received"):
        download("fr1_xyz", tmp_path, server.url)
    assert [path.name for path in tmp_path.iterdir()] == [f"{FOLDER}.tgz.part"]
    assert is_whole(download("fr1_xyz", tmp_path, server.url), tmp_path)
    assert server.requests[-1][1] is not None


def test_a_part_longer_than_the_file_is_dropped(server: Server, tmp_path: Path):
    (tmp_path / f"{FOLDER}.tgz.part").write_bytes(b"z" * (len(server.content) + 5))
    assert is_whole(download("fr1_xyz", tmp_path, server.url), tmp_path)


@pytest.mark.parametrize("length", ["abc", "-5", "²", "9" * 5000])
def test_a_size_that_is_no_number_tells_nothing(server: Server, tmp_path: Path, length: str):
    server.length = length
    assert is_whole(download("fr1_xyz", tmp_path, server.url), tmp_path)


@pytest.mark.parametrize(
    "address", ["foo", "ftp://x/", "http://[", "http://h:abc", f"http://{'a' * 300}/", "http://a b/"]
)
def test_an_address_that_is_none_is_one_line(server: Server, tmp_path: Path, monkeypatch, capsys, address: str):
    monkeypatch.setenv("GAVO_TUM_SERVER", address)
    assert main(["download", "fr1_xyz", "--to", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("address", ["foo", "-1", "/srv/tum", "ftp://x/", "http://"])
def test_an_address_of_no_server_names_the_variable(server: Server, tmp_path: Path, monkeypatch, capsys, address: str):
    """It was said to have broken off five times."""
    monkeypatch.setenv("GAVO_TUM_SERVER", address)
    assert main(["download", "fr1_xyz", "--to", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("gavo: GAVO_TUM_SERVER: not the address of a server")


def test_data_in_ones_home_needs_no_shell(server: Server, tmp_path: Path, monkeypatch):
    """A folder ~ was made in the working directory."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("GAVO_TUM_SERVER", server.url)
    monkeypatch.setenv("GAVO_DATA", "~/data")
    monkeypatch.chdir(tmp_path)
    assert main(["download", "fr1_xyz"]) == 0
    assert is_whole(tmp_path / "home" / "data" / FOLDER, tmp_path / "home" / "data")


def test_names_in_an_archive_do_not_command_the_terminal(server: Server, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("GAVO_TUM_SERVER", server.url)
    server.content = archive(member("\x1b]0;gotcha\x07\x1b[31m\x9b31m\u202eevil.txt"))
    assert main(["download", "fr1_xyz", "--to", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "\\x1b]0;gotcha\\x07" in error and error[:-1].isprintable()


def test_two_downloads_at_once(server: Server, tmp_path: Path):
    """The second does not write into the first one's file."""
    with hold(tmp_path, f".{FOLDER}.lock"):
        with pytest.raises(GavoError, match="in use"):
            download("fr1_xyz", tmp_path, server.url)
        assert not server.requests
    assert is_whole(download("fr1_xyz", tmp_path, server.url), tmp_path)


def test_what_a_kill_left_half_unpacked_is_removed(server: Server, tmp_path: Path):
    (tmp_path / f".unpacking-{FOLDER}" / FOLDER).mkdir(parents=True)
    (tmp_path / f".unpacking-{FOLDER}" / FOLDER / "rgb.txt").write_text("half")
    assert is_whole(download("fr1_xyz", tmp_path, server.url), tmp_path)


def test_server_refuses(server: Server, tmp_path: Path):
    server.faults = ["404"]
    with pytest.raises(GavoError, match="404"):
        download("fr1_xyz", tmp_path, server.url)
    assert len(server.requests) == 1 and not list(tmp_path.iterdir())


UNSAFE = {
    "path above": archive(member("../evil.txt")),
    "absolute path": archive(member("/tmp/evil.txt")),
    "beside the folder": archive(member("evil.txt")),
    "symbolic link": archive(member(f"{FOLDER}/link", tarfile.SYMTYPE, "rgb.txt")),
    "link out": archive(member(f"{FOLDER}/link", tarfile.SYMTYPE, "../../..")),
    "hard link": archive(member(f"{FOLDER}/link", tarfile.LNKTYPE, f"{FOLDER}/rgb.txt")),
    "device": archive(member(f"{FOLDER}/null", tarfile.CHRTYPE)),
    "another folder": archive(folder="rgbd_dataset_freiburg1_desk"),
    "no archive": b"<html>moved</html>" * 100,
    "torn archive": archive()[:-2000],
    "wrong checksum": archive()[:-8] + bytes(4) + archive()[-4:],
}


@pytest.mark.parametrize("content", UNSAFE.values(), ids=UNSAFE.keys())
def test_unsafe_archives_leave_nothing(server: Server, tmp_path: Path, content: bytes):
    to = tmp_path / "below" / "data"
    server.content = content
    with pytest.raises(GavoError, match=FOLDER):
        download("fr1_xyz", to, server.url)
    assert not list(to.iterdir()) and [path.name for path in tmp_path.rglob("*")] == ["below", "data"]


def test_stalling_server_is_given_up(server: Server, tmp_path: Path):
    server.faults = ["stall"] * module.ATTEMPTS
    start = time.monotonic()
    with pytest.raises(GavoError, match=rf"broke off {module.ATTEMPTS} times: .*keeps what was received"):
        download("fr1_xyz", tmp_path, server.url)
    assert time.monotonic() - start < 10
