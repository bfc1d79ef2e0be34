"""A stranger gets nothing: each endpoint, by each way that a stranger may try, over the wire."""

import contextlib
import random
import socket
import ssl
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import psutil
import pytest
from patience import PATIENCE
from watched_feed import Feed, self_signed

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.served.credentials import check_credentials, read_token, tls_context
from gapbridge.bridge.served.protocol import HEADER_TIME, LARGEST_HEAD, MOST_CONNECTIONS
from gapbridge.bridge.served.settings import ServedSettings
from gapbridge.core.errors import CellError, InputError

TOKEN = "7d1f0c3a9b8e4f62a5d07c1e93b8462f"
PATHS = ("", "status", "history", "events", "page.js", "style.css", "messages.js", "view.js",
         "drawing.js",
         "icon.svg", "metrics", "nothing")  # fmt: skip


@pytest.fixture(scope="module")
def token_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("secrets") / "token"
    path.write_text(TOKEN + "\n")
    path.chmod(0o600)
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The page as it is by default: on loopback, without a token."""
    with Feed(tmp_path_factory.mktemp("plain"), "web", clients=4) as feed:
        feed.wait("status")
        yield feed


@pytest.fixture(scope="module")
def guarded(tmp_path_factory, token_file):
    """The page with TLS and a token."""
    folder = tmp_path_factory.mktemp("guarded")
    certificate, key = self_signed(folder)
    with Feed(
        folder, "web", certificate=str(certificate), key=str(key), token_file=str(token_file)
    ) as feed:
        feed.context = ssl.create_default_context(cafile=str(certificate))
        feed.wait("status", verify=feed.context)
        yield feed


@pytest.fixture(scope="module")
def metrics(tmp_path_factory, token_file):
    with Feed(tmp_path_factory.mktemp("counted"), "metrics", token_file=str(token_file)) as feed:
        feed.wait("metrics")
        yield feed


def client(feed, **keys):
    return httpx.Client(base_url=feed.url, verify=feed.context, timeout=15, **keys)


def raw(feed, data, limit=3.0):
    """Return what comes back for some bytes until the other side closes, or ``limit`` s."""
    found = b""
    link = socket.create_connection(("127.0.0.1", feed.port), timeout=limit)
    with link, contextlib.suppress(OSError):
        link.sendall(data)
        while piece := link.recv(65536):
            found += piece
    return found


def answers(feed):
    """Return whether an honest reader gets through once what hangs there was cut off."""
    until = time.monotonic() + HEADER_TIME + 10
    while time.monotonic() < until:
        with contextlib.suppress(httpx.TransportError):
            return httpx.get(feed.url + "status").status_code == 200
        time.sleep(0.1)
    return False


# -- who may be listened to ------------------------------------------------------------------------


@pytest.mark.parametrize("section", ["web", "metrics"])
@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ("{host: 0.0.0.0}", "certificate, key, token_file left out"),
        ("{host: 192.168.7.7, certificate: c.pem, key: k.pem}", "token_file left out"),
        ("{host: '::', token_file: token}", "certificate, key left out"),
        ("{host: robot.example}", "found 'robot.example', expected an address"),
        ("{certificate: c.pem}", "certificate and key together"),
    ],
)
def test_a_cell_that_would_serve_strangers_is_refused_in_one_line(tmp_path, section, keys, says):
    path = tmp_path / "cell.yaml"
    path.write_text(f"robot: {{model: ur10e}}\n{section}: {keys}\n")
    with pytest.raises(CellError) as error:
        load_cell(path)
    assert says in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_loopback_is_what_a_section_without_keys_gets(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("robot: {model: ur10e}\nweb: {}\nmetrics: {}\n")
    cell = load_cell(path)
    assert cell.web.host == cell.metrics.host == "127.0.0.1"
    path.write_text("robot: {model: ur10e}\n")
    assert load_cell(path).web is None


@pytest.mark.parametrize(
    ("mode", "text", "says"),
    [
        (0o644, TOKEN, "found mode 0644, expected 0600"),
        (0o640, TOKEN, "found mode 0640"),
        (0o600, "short", "found 5 characters"),
        (0o600, "", "found 0 characters"),
        (0o600, TOKEN + " " + TOKEN, "expected 32 to"),
        (0o600, TOKEN + "\n" + TOKEN, "expected 32 to"),
    ],
)
def test_a_token_that_others_read_or_guess_is_refused_and_never_quoted(tmp_path, mode, text, says):
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(InputError) as error:
        read_token(path, ("web", "token_file"))
    assert says in str(error.value)
    assert TOKEN not in str(error.value)


def test_a_certificate_that_cannot_be_used_is_refused(tmp_path, token_file):
    certificate, key = self_signed(tmp_path)
    path = tmp_path / "cell.yaml"
    path.write_text(
        f"robot: {{model: ur10e}}\nweb: {{host: 0.0.0.0, certificate: certificate.pem, "
        f"key: key.pem, token_file: {token_file}}}\n"
    )
    check_credentials(load_cell(path).web, "web")
    key.write_text("no key\n")
    with pytest.raises(InputError, match=r"web.certificate: .*cannot be used"):
        check_credentials(load_cell(path).web, "web")
    certificate.unlink()
    with pytest.raises(InputError, match=r"web.certificate: .*found no file"):
        check_credentials(load_cell(path).web, "web")


def test_nothing_older_than_tls_1_2_is_spoken(tmp_path):
    certificate, key = self_signed(tmp_path)
    context = tls_context(ServedSettings(certificate=certificate, key=key), "web")
    assert context.minimum_version == ssl.TLSVersion.TLSv1_2


@pytest.mark.slow
def test_the_processes_listen_where_they_are_configured_and_nowhere_else(plain, guarded, metrics):
    for feed in (plain, guarded, metrics):
        found = psutil.Process(feed.side.pid).net_connections("inet")
        listening = {c.laddr for c in found if c.status == psutil.CONN_LISTEN}
        assert {(a.ip, a.port) for a in listening} == {("127.0.0.1", feed.port)}


# -- token -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PATHS)
def test_without_the_token_there_is_a_form_and_nothing_else(guarded, path):
    with client(guarded) as browser:
        answer = browser.get(path)
        assert answer.status_code == 401
        assert "run-2026" not in answer.text
        assert "ur10e" not in answer.text
        assert ("<form" in answer.text) == (path == "")


WRONG = [
    {"authorization": "Bearer " + TOKEN[:-1]},
    {"authorization": "Bearer " + TOKEN + "0"},
    {"authorization": "Basic " + TOKEN},
    {"authorization": TOKEN},
    {"authorization": "Bearer"},
    {"cookie": "gapbridge-{port}=" + TOKEN},
    {"cookie": "gapbridge-{port}=" + 64 * "0"},
    {"cookie": '=;;="\\'},
]


def test_a_wrong_token_opens_nothing(guarded):
    def asked(headers, path):
        headers = {k: v.replace("{port}", str(guarded.port)) for k, v in headers.items()}
        with client(guarded, headers=headers) as browser:
            return browser.get(path).status_code

    each = [(headers, path) for headers in WRONG for path in ("status", "events")]
    with ThreadPoolExecutor(len(each)) as pool:  # all at once: each is answered late
        found = list(pool.map(asked, *zip(*each, strict=True)))
    assert found == [401] * len(each), list(zip(each, found, strict=True))


def test_a_token_in_the_address_opens_nothing(guarded):
    with client(guarded) as browser:
        assert browser.get("status", params={"token": TOKEN}).status_code == 401


def test_the_right_token_opens_for_programs_and_signing_in_for_browsers(guarded):
    with client(guarded, headers={"authorization": f"Bearer {TOKEN}"}) as program:
        assert program.get("status").json()["session"] == guarded.session
    with client(guarded) as browser:
        assert browser.post("session", data={"token": "wrong" + TOKEN}).status_code == 401
        assert not browser.cookies
        answer = browser.post("session", data={"token": TOKEN})
        assert answer.status_code == 303
        cookie = answer.headers["set-cookie"]
        assert TOKEN not in cookie
        assert all(part in cookie for part in ("HttpOnly", "SameSite=Strict", "Secure"))
        assert browser.get("status").json()["session"] == guarded.session


def test_the_form_takes_no_more_than_a_token(guarded):
    with client(guarded) as browser:
        assert browser.post("session", content=b"token=" + 100_000 * b"a").status_code == 400
        assert browser.post("session", data={f"k{i}": "v" for i in range(50)}).status_code == 400
        assert browser.post("session", content=b"\xff\xfe").status_code == 401


def test_metrics_need_the_token_too(metrics):
    assert httpx.get(metrics.url + "metrics").status_code == 401
    wrong = {"authorization": "Bearer " + 32 * "0"}
    assert httpx.get(metrics.url + "metrics", headers=wrong).status_code == 401
    right = {"authorization": f"Bearer {TOKEN}"}
    answer = httpx.get(metrics.url + "metrics", headers=right)
    assert answer.status_code == 200
    assert 'gapbridge_requests_refused_total{reason="token"}' in answer.text
    assert TOKEN not in answer.text


# -- names, methods, sizes -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("evil.example", 421), ("evil.example:30380", 421), ("127.0.0.1.evil.example", 421),
        ("localhost.evil.example", 421), ("", 421), ("127.0.0.1", 200), ("localhost:1", 200),
        ("[::1]:30380", 200), ("LOCALHOST", 200),
    ],
)  # fmt: skip
def test_a_name_that_is_not_ours_is_refused(plain, host, status):
    found = raw(
        plain, f"GET /status HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode()
    )
    assert found.startswith(f"HTTP/1.1 {status}".encode())
    assert (b"run-2026" in found) == (status == 200)


@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "ARM"])
def test_nothing_but_reading_is_possible(plain, method):
    for path in ("status", "events", "arm", "session", ""):
        assert httpx.request(method, plain.url + path).status_code == 405


def test_every_answer_forbids_what_a_page_could_be_made_to_do(plain):
    for path in ("", "status", "page.js", "nothing"):
        headers = httpx.get(plain.url + path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        assert "access-control-allow-origin" not in headers
        assert "server" not in headers


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + 4 * LARGEST_HEAD * b"a" + b"\r\n\r\n",
        b"GET /" + 4 * LARGEST_HEAD * b"a" + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\n" + 4000 * b"A: b\r\n" + b"\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET /status HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello",
        b"GET /status HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"GET /status HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"\x00" * 5000,
        b"GET /../../etc/passwd HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n",
        b"GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n",
    ],
)
def test_malformed_and_oversized_requests_get_nothing(plain, data):
    found = raw(plain, data, HEADER_TIME + 3)
    assert b" 200 " not in found[:40]
    assert b"run-2026" not in found
    assert b"Traceback" not in found
    assert b"root:" not in found
    assert answers(plain)


def test_noise_brings_nothing_down(plain):
    generator = random.Random(11)
    whole = b"GET /history?seconds=9 HTTP/1.1\r\nHost: localhost\r\nCookie: a=b\r\n\r\n"
    before = plain.side.pid
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(generator.randrange(1, 12)):
            data[generator.randrange(len(data))] = generator.randrange(256)
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", plain.port), timeout=2) as link,
        ):
            link.sendall(data)
    assert answers(plain)
    assert plain.side.check() is None
    assert plain.side.pid == before


@pytest.mark.parametrize(
    "query", ["seconds=nan", "seconds=1e9", "points=1e12", "points=-1", "seconds=x"]
)
def test_history_gives_no_more_than_is_asked_for_reasonably(plain, query):
    answer = httpx.get(f"{plain.url}history?{query}")
    assert answer.status_code == 400
    assert "expected 1 to" in answer.text


# -- slow and many ---------------------------------------------------------------------------------


def test_heads_that_never_end_are_cut_off_and_hold_nobody_up(plain):
    links = []
    try:
        for _ in range(3 * MOST_CONNECTIONS):
            link = socket.create_connection(("127.0.0.1", plain.port), timeout=15)
            link.sendall(b"GET /status HTTP/1.1\r\nHost: loc")
            links.append(link)
        begun = time.monotonic()
        open_now = links
        while open_now and time.monotonic() - begun < HEADER_TIME + 20:
            time.sleep(0.5)
            open_now = [link for link in open_now if not _closed(link, b"a")]
        assert open_now == []
        assert httpx.get(plain.url + "status").status_code == 200
    finally:
        for link in links:
            link.close()
    connections = psutil.Process(plain.side.pid).net_connections("inet")
    assert len(connections) < MOST_CONNECTIONS


def _closed(link, trickle):
    """Send one more byte, as slowloris does; return whether the other side has gone."""
    try:
        link.sendall(trickle)
        link.setblocking(False)
        return link.recv(1) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
    finally:
        link.settimeout(5)


def test_no_more_pages_are_open_than_allowed_and_those_that_are_go_on(plain):
    with contextlib.ExitStack() as stack:
        lines = []
        for _ in range(4):
            answer = stack.enter_context(httpx.stream("GET", plain.url + "events", timeout=15))
            assert answer.status_code == 200
            lines.append(answer.iter_lines())
            next(lines[-1])
        refused = httpx.get(plain.url + "events")
        assert refused.status_code == 503
        assert any("tick" in next(lines[0]) for _ in range(40))
    until = time.monotonic() + PATIENCE
    while True:  # places come free again
        with httpx.stream("GET", plain.url + "events", timeout=15) as answer:
            if answer.status_code == 200:
                break
        assert time.monotonic() < until
        time.sleep(0.1)
