"""play: the server answers its own page alone, a change with a picture, and what is malformed with one sentence."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from avatar.play import server as serving
from avatar.play.drawing import jpeg
from avatar.play.server import Server
from tests.made_play import FRAMES, MadeFinder, html, read_back, session


def offer(name: str, data: bytes) -> dict:
    if not data:
        raise ValueError("the file is empty; its first line must name the columns")
    offered.append((name, data))
    return {"frames": FRAMES}


offered: list[tuple[str, bytes]] = []


@pytest.fixture(scope="module")
def served() -> Iterator[Server]:
    with session(MadeFinder(lambda _: None)) as running, pytest.MonkeyPatch.context() as patch:
        patch.setattr(serving, "PATIENCE_S", 0.3)
        server = Server(running, html(running), offer)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        server.server_close()


def ask(server: Server, method: str, path: str, body: bytes | None = None, **headers: str):
    """Status, headers and body of one request, as a browser sends it."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    try:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path if path.startswith("//") else f"/{server.token}/{path}", body, named)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def change(server: Server, **wish: object) -> int:
    status, _, body = ask(server, "POST", "state", json.dumps(wish).encode())
    assert status == 200, body
    return json.loads(body)["version"]


def picture(server: Server, version: int, after: int = 0) -> tuple[dict, bytes]:
    for _ in range(50):
        status, headers, body = ask(server, "GET", f"picture?after={after}")
        if status == 200:
            facts = json.loads(headers["X-Play"])
            if facts["version"] >= version:
                assert headers["Content-Type"] == "image/jpeg" and len(body) == int(headers["Content-Length"])
                return facts, body
            after = facts["number"]
    raise AssertionError("no picture of this version came")


def test_a_change_of_a_parameter_is_answered_with_a_picture(served: Server) -> None:
    for jaw in (0.2, 0.9):
        facts, body = picture(served, change(served, sliders={"jawOpen": jaw}))
        assert read_back(body)[0] == pytest.approx(jaw, abs=0.02)
    assert ask(served, "GET", f"picture?after={facts['number']}")[0] == 204  # nothing new
    status, _, body = ask(served, "GET", "state")
    assert status == 200 and json.loads(body)["sliders"]["jawOpen"] == 0.9
    change(served, reset=True)


def test_it_listens_on_the_loopback_address_alone(served: Server) -> None:
    assert served.socket.getsockname()[0] == "127.0.0.1"
    assert served.address == f"http://127.0.0.1:{served.server_port}/{served.token}/" and len(served.token) >= 20


def test_the_page_is_whole_and_says_that_it_is_synthetic(served: Server) -> None:
    status, headers, body = ask(served, "GET", "")
    text, policy = body.decode(), headers["Content-Security-Policy"]
    assert status == 200 and "synthetic rendering of ann &lt;b&gt;" in text and "<b>ann" not in text
    nonce = policy.split("script-src 'nonce-")[1].split("'")[0]
    assert text.count(f'nonce="{nonce}"') == text.count("<script") + text.count("<style") == 3
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy
    for outside in ("http://", "https://", 'src="', "@import", "url("):
        assert outside not in text.replace('href="data:,"', ""), outside
    assert nonce not in ask(served, "GET", "")[2].decode()
    for name, value in serving.HEADERS.items():
        assert headers[name] == value


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),
        ({"Host": "evil.example:{port}"}, 421),
        ({"Host": "127.0.0.1"}, 421),
        ({"Host": "127.0.0.1:{port}.evil.example"}, 421),
        ({"Host": "0.0.0.0:{port}"}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://127.0.0.1:1"}, 403),
        ({"Origin": "https://127.0.0.1:{port}"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
    ],
)
@pytest.mark.parametrize(("method", "path"), [("GET", ""), ("GET", "picture"), ("POST", "state"), ("POST", "camera")])
def test_strangers_are_refused(served: Server, headers: dict[str, str], status: int, method: str, path: str) -> None:
    before = served.session.state()
    headers = {name: value.format(port=served.server_port) for name, value in headers.items()}
    found, got, body = ask(served, method, path, b'{"size": 48}' if method == "POST" else None, **headers)
    assert found == status and set(json.loads(body)) == {"error"} and "Access-Control-Allow-Origin" not in got
    assert served.session.state() == before


@pytest.mark.parametrize(
    "headers", [{}, {"Host": "localhost:{port}"}, {"Origin": "http://127.0.0.1:{port}", "Sec_Fetch_Site": "same-origin"}]
)
def test_its_own_page_is_not(served: Server, headers: dict[str, str]) -> None:
    headers = {name: value.format(port=served.server_port) for name, value in headers.items()}
    assert ask(served, "GET", "state", **headers)[0] == 200


@pytest.mark.parametrize(
    "path",
    ["", "state", "{token}", "{token}x/state", "{short}/state", "wrong/state", "%2e%2e/etc/passwd", "..//{token}/state"],
)
def test_without_the_token_there_is_nothing(served: Server, path: str) -> None:
    path = path.format(token=served.token, short=served.token[:-1])
    connection = http.client.HTTPConnection("127.0.0.1", served.server_port, timeout=20)
    connection.request("GET", "/" + path)
    answer = connection.getresponse()
    assert answer.status == 404 and json.loads(answer.read()) == {"error": "there is nothing here"}
    connection.close()


@pytest.mark.parametrize("path", ["nothing", "state/", "../state", "picture/../../x", "avatar.pt"])
def test_other_paths_are_nothing(served: Server, path: str) -> None:
    assert ask(served, "GET", path)[0] == 404
    assert ask(served, "POST", path, b"{}")[0] == 404


@pytest.mark.parametrize(
    ("path", "body", "said"),
    [
        ("state", b"", "JSON"),
        ("state", b"{", "JSON"),
        ("state", b"[]", "object"),
        ("state", b'{"volume": 3}', "volume"),
        ("state", b'{"source": "http://x"}', "source"),
        ("state", b'{"size": 100000}', "size"),
        ("state", b'{"size": "48"}', "size"),
        ("state", b'{"strength": NaN}', "JSON|strength"),
        ("state", b'{"strength": 1e999}', "strength"),
        ("state", b'{"sliders": {"jawOpen": 7}}', "jawOpen goes from 0 to 1"),
        ("state", b'{"sliders": {"jawOpen": null}}', "jawOpen"),
        ("state", b'{"sliders": {"\\u0000": 0}}', "there is no slider"),
        ("state", b'{"place": 5}', "there is no frame 5"),
        ("state", b'{"source": "file"}', "there is no source file"),
        ("state", b"\xff\xfe", "JSON"),
        ("state", b"[" * 5000, "JSON"),
        ("camera", b"GIF89a", "must be a JPEG"),
        ("camera", b"", "must be a JPEG"),
        ("file?name=x.csv", b"", "the file is empty"),
    ],
)
def test_what_is_malformed_gets_400_and_a_sentence(
    served: Server, path: str, body: bytes, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = served.session.state()
    status, _, answer = ask(served, "POST", path, body)
    sentence = json.loads(answer)["error"]
    assert status == 400 and any(word in sentence for word in said.split("|")), sentence
    assert "\n" not in sentence and served.session.state() == before
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("after", ["-1", "x", "1e3", "9" * 40, "%00"])
def test_numbers_of_pictures_are_numbers(served: Server, after: str) -> None:
    assert ask(served, "GET", f"picture?after={after}")[0] == 400


def test_sizes_of_messages_are_bounded_and_stated(served: Server) -> None:
    assert ask(served, "POST", "state", b" " * ((1 << 16) + 1))[0] == 413
    head = f"POST /{served.token}/state HTTP/1.1\r\nHost: 127.0.0.1:{served.server_port}\r\n"
    for more, status in (("\r\n", 411), ("Content-Length: -5\r\n\r\n", 411), ("Content-Length: 99999999999\r\n\r\n", 413)):
        with socket.create_connection(("127.0.0.1", served.server_port), timeout=20) as line:
            line.sendall((head + more).encode())
            assert line.recv(1 << 16).split()[1] == str(status).encode()


def test_two_host_headers_are_one_too_many(served: Server) -> None:
    own = f"127.0.0.1:{served.server_port}"
    with socket.create_connection(("127.0.0.1", served.server_port), timeout=20) as line:
        line.sendall(f"GET /{served.token}/state HTTP/1.1\r\nHost: {own}\r\nHost: evil.example\r\n\r\n".encode())
        assert line.recv(1 << 16).split()[1] == b"421"


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "HEAD", "CONNECT"])
def test_other_methods_are_not_known(served: Server, method: str) -> None:
    assert ask(served, method, "state")[0] == 501


def test_a_camera_picture_is_taken_only_while_the_camera_is_chosen(served: Server) -> None:
    data = jpeg(np.zeros((48, 64, 3), np.uint8), 90)
    taken = lambda: json.loads(ask(served, "POST", "camera", data)[2])["taken"]  # noqa: E731
    assert not taken() and ask(served, "GET", "driver")[0] == 204
    change(served, source="camera")
    assert taken()
    status, _, body = 204, None, b""
    for _ in range(100):
        if status == 200:
            break
        status, _, body = ask(served, "GET", "driver")
    assert status == 200 and body[:2] == b"\xff\xd8"
    change(served, source="sliders")
    assert not taken()


def test_a_file_is_handed_on_with_its_name(served: Server) -> None:
    status, _, body = ask(served, "POST", "file?name=wave%20me.csv", b"jawOpen\n0\n")
    assert status == 200 and json.loads(body) == {"frames": FRAMES} and offered[-1] == ("wave me.csv", b"jawOpen\n0\n")


def test_one_connection_serves_many_requests(served: Server) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", served.server_port, timeout=20)
    for k in range(5):
        connection.request("POST", f"/{served.token}/state", json.dumps({"strength": 1 + k / 10}))
        answer = connection.getresponse()
        assert answer.status == 200 and answer.read()
    connection.close()
    change(served, reset=True)
