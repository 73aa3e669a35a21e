"""The live page: its data, access to it, and display in a real browser."""

import contextlib
import email
import json
import math
import shutil
import socket
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

import drivers
from cycloid_fmu import edge
from cycloid_fmu.edge import page_server
from drivers.live_page import server as server_module
from drivers.live_page.server import Watcher, WatchServer, order_spectrum
from drivers.recording_format import Channel, Event, Header, RecordingWriter, Samples

ARCSEC = math.pi / 648000
CHROMIUM = shutil.which("chromium")


def channel(name, unit):
    return Channel(name, name, "canopen", unit, 1 << 22, 1, 0.0, "absolute", "node 1", "SYNC")


HEADER = Header(
    (channel("input_angle", "rad"), channel("output_angle", "rad"), channel("torque", "N*m")),
    {},
    -39.0,
    "pair-39-40",
    "2025-01-01T00:00:00Z",
)


def write_turns(writer, first, count, amplitude=30 * ARCSEC, order=2):
    """Write samples of a drive whose TE is a single order, 96 samples per crank turn."""
    time = np.arange(first, first + count) / 96
    angle = 2 * math.pi * time
    output = angle / -39 + amplitude * np.sin(order * angle)
    for name, value in (("input_angle", angle), ("output_angle", output), ("torque", np.full(count, 20.0))):
        writer.write(Samples.checked(name, time, value))


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("turns", [1, 3.7, 40])
def test_the_spectrum_of_one_order_is_that_order(direction, turns):
    angle = direction * np.arange(0, 2 * math.pi * turns + 1e-3, 2 * math.pi / 96)
    orders, amplitudes = order_spectrum(angle, 7.0 * np.cos(5 * angle + 0.3))
    assert orders[np.argmax(amplitudes)] == 5
    assert amplitudes.max() == pytest.approx(7.0, rel=0.03)
    assert np.sort(amplitudes)[-2] < 0.35


def test_a_growing_recording_is_shown(tmp_path):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        watcher = Watcher(path)
        assert watcher.refresh()["te"] is None
        for n in range(3):
            write_turns(writer, 192 * n, 192)
            data = watcher.refresh()
            assert [c["samples"] for c in data["channels"]] == [192 * (n + 1)] * 3
        assert data["spectrum"]["orders"][int(np.argmax(data["spectrum"]["arcsec"]))] == 2
        assert max(data["te"]["arcsec"]) == pytest.approx(30, abs=0.1)
    json.dumps(watcher.refresh())


@pytest.fixture
def serve():
    servers = []

    def start(watcher, token=None):
        server = WatchServer(watcher, "127.0.0.1", 0, token)
        servers.append(server)
        return server

    yield start
    for server in servers:
        server.server_close()


def status_of(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=5) as answer:
            return answer.status
    except urllib.error.HTTPError as problem:
        return problem.code


def test_the_page_requires_a_token_or_a_local_name(tmp_path, serve):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER):
        pass
    local = serve(Watcher(path))
    assert status_of(local.url) == 200
    assert status_of(local.url, Host="evil.example:80") == 403, "a foreign name that resolves to this machine"
    assert status_of(local.url + "nothing") == 404
    secret = serve(Watcher(path), token="s3cret")
    bare = secret.url.split("?")[0]
    assert status_of(secret.url) == 200
    assert status_of(bare) == status_of(bare + "?token=guess") == status_of(bare + "data") == 403


def test_a_port_in_use_is_reported_in_one_sentence(tmp_path, serve):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER):
        pass
    port = serve(Watcher(path)).server_address[1]
    with pytest.raises(edge.InputError, match=f"port = {port}: 127.0.0.1 can't be listened on"):
        drivers.watch(path, port=port)


def test_a_slow_client_skips_to_the_newest(tmp_path, serve):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        server = serve(Watcher(path))
        number, _ = server.newest.after(0, 5.0)
        write_turns(writer, 0, 96)
        while True:  # the server reads five times per second regardless of clients
            now, text = server.newest.after(number, 5.0)
            assert now > number
            if json.loads(text)["channels"][0]["samples"] == 96:
                break
            number = now
        assert server.newest.after(0, 0.0)[1] == text or server.newest.after(0, 0.0)[0] > now


@pytest.mark.system
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_real_browser_shows_it(tmp_path, serve):
    from playwright.sync_api import sync_playwright

    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer, sync_playwright() as playwright:
        write_turns(writer, 0, 96 * 4)
        server = serve(Watcher(path), token="s3cret")
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        problems = []
        page.on("pageerror", lambda problem: problems.append(str(problem)))
        page.goto(server.url)
        page.wait_for_selector("text=largest: order 2, 30.00″")
        assert "pair-39-40, ratio -39" in page.text_content("#title")
        assert page.text_content("#te-note") == "60.00″ peak to peak"
        write_turns(writer, 96 * 4, 96)
        writer.write(Samples.checked("torque", [], []), [Event(1.0, "torque", "<b>cable</b> pulled")])
        page.wait_for_selector("#channels tr:first-child td:text-is('480')")
        page.wait_for_selector("#events:has-text('<b>cable</b> pulled')")  # text, not markup
        inked = page.evaluate(
            "[...document.querySelectorAll('canvas')].map(c => c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data.filter((v, i) => i % 4 == 3 && v > 0).length)"
        )
        assert min(inked) > 1000
        page.screenshot(path=tmp_path / "watch.png")
        browser.close()
        assert problems == []


def asked(server, request):
    """Send bytes and return all that comes back until the server closes."""
    with socket.create_connection(server.server_address, timeout=5) as client:
        client.sendall(request)
        client.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: client.recv(1 << 16), b""))


def test_nan_values_are_null_and_left_out_of_the_transmission_error(tmp_path):
    with RecordingWriter(tmp_path / "run.arrows", HEADER) as writer:
        write_turns(writer, 0, 192)
        for name in ("input_angle", "output_angle", "torque"):
            writer.write(Samples.checked(name, [2.0], [math.nan]), [Event(math.inf, name, "odd")])
    with WatchServer(Watcher(tmp_path / "run.arrows"), "127.0.0.1", 0, None) as server:
        _, text = server.newest.after(0, 5.0)

    def refused(word):
        raise AssertionError(word)

    data = json.loads(text, parse_constant=refused)  # as JSON.parse
    assert "\n" not in text
    assert {c["value"] for c in data["channels"]} == {None}
    assert max(data["te"]["arcsec"]) == pytest.approx(30, abs=0.1)


@pytest.mark.parametrize(
    "line",
    [
        "GET http://[::1 HTTP/1.0",
        "GET //[ HTTP/1.0",
        "GET /?" + "a&" * 99 + "token=x HTTP/1.0",
        "GET",
        "\0",
        "GET / HTTP/9.9",
        "BREW / HTTP/1.1",
        "GET /\xff HTTP/1.0",
        "GET " + "/" * 70000,
        "GET /?token=%00%ff HTTP/1.1\r\nHost: \xff",
    ],
)
@pytest.mark.parametrize("token", [None, "s3cret"])
def test_an_invalid_request_is_refused_and_nothing_is_printed(tmp_path, serve, capfd, line, token):
    with RecordingWriter(tmp_path / "run.arrows", HEADER):
        pass
    server = serve(Watcher(tmp_path / "run.arrows"), token)
    answer = asked(server, line.encode("latin-1") + b"\r\n\r\n")
    assert not answer.startswith(b"HTTP/1.0 200")
    if answer:
        headers = email.message_from_bytes(answer.partition(b"\r\n")[2])
        if headers.keys():
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert headers["X-Frame-Options"] == "DENY"
            assert headers["Referrer-Policy"] == "no-referrer"
            assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
            assert "unsafe" not in headers["Content-Security-Policy"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.system
def test_slow_or_surplus_clients_are_disconnected(tmp_path, serve, monkeypatch):
    monkeypatch.setattr(page_server, "REQUEST_SECONDS", 0.5)
    with RecordingWriter(tmp_path / "run.arrows", HEADER):
        pass
    server = serve(Watcher(tmp_path / "run.arrows"))
    clients = [socket.create_connection(server.server_address, timeout=5) for _ in range(40)]
    ended = 0
    for client in clients:  # none of them ever ends its request
        with client, contextlib.suppress(ConnectionError):
            client.sendall(b"GET / HTTP/1.1\r\nX: ")
            ended += client.recv(1) == b""
            continue
        ended += 1
    assert ended == len(clients)
    while server._ends:  # their threads end by themselves
        time.sleep(0.01)
    assert status_of(server.url) == 200


def test_a_stream_ends_after_its_time_and_frees_its_place(tmp_path, serve, monkeypatch):
    monkeypatch.setattr(server_module, "_STREAM_SECONDS", 0.3)
    with RecordingWriter(tmp_path / "run.arrows", HEADER):
        pass
    server = serve(Watcher(tmp_path / "run.arrows"))
    answer = asked(server, b"GET /data HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert b"text/event-stream" in answer
    assert b"data: {" in answer
