"""The local page: what it serves, to whom, that it needs nothing from outside, and that a browser shows it."""

import http.client
import json
import re
import shutil
import subprocess
import threading
from importlib.resources import files

import numpy as np
import pytest

from tomo_polysplat.cli.main import build_parser, main
from tomo_polysplat.cli.view import shown_by
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.viewer.server import Server
from tomo_polysplat.viewer.volumes import shown_of

SHAPE = (5, 7, 9)
GRID = VolumeGrid(SHAPE, (-0.9, -0.7, -1.0), (0.9, 0.7, 1.0))
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def result(factor=1.0, **changes):
    values = factor * np.random.default_rng(1).random(SHAPE)
    return Result(values[None], GRID, **changes)


@pytest.fixture
def server():
    shown = shown_of(result(), {"FDK": result(25.0)}, "wrist <left>", "<p>below</p>")
    with Server(shown) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def ask(server, path, host=None, secret=None):
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=5)
    secret = server.secret if secret is None else secret
    headers = {"Host": host} if host else {}
    connection.request("GET", f"/{secret}/{path}", headers=headers)
    reply = connection.getresponse()
    return reply, reply.read()


@pytest.mark.parametrize("unit_factor", [1e-5, 1.0, 1e4])
def test_slices_are_right_to_one_in_two_thousand(unit_factor):
    """Whatever the unit of length: half precision has 11 bits, and soft matter lies a hundred times below metal."""
    volume = result(unit_factor).volume
    shown = shown_of(result(unit_factor), {"metal": result(100 * unit_factor)}, "x")
    for axis, index in ((0, 3), (1, 6), (2, 8)):
        half = np.frombuffer(shown.slice(0, axis, index), "<f2").astype(float) / shown.scale
        expected = volume.take(index, axis)
        np.testing.assert_allclose(half.reshape(expected.shape), expected, rtol=2**-11)


def test_slices_and_numbers_come_by_address(server):
    reply, content = ask(server, "slice/1/2/4")
    assert reply.status == 200 and len(content) == 2 * SHAPE[0] * SHAPE[1]
    half = np.frombuffer(content, "<f2").astype(float).reshape(SHAPE[:2]) / server.shown.scale
    np.testing.assert_allclose(half, result(25.0).volume[:, :, 4], rtol=1e-3)
    about = json.loads(ask(server, "about.json")[1])
    assert about["shape"] == list(SHAPE) and about["names"] == ["tomo-polysplat", "FDK"]
    assert about["voxel"] == pytest.approx([0.4, 0.2, 0.2])
    page = ask(server, "")[1].decode()
    assert "wrist &lt;left&gt;" in page and "<p>below</p>" in page


@pytest.mark.parametrize(
    "path",
    [
        "slice/2/0/0",
        "slice/0/3/0",
        "slice/0/0/5",
        "slice/0/0/-1",
        "slice/0/0",
        "slice/0/0/\u0663",
        "page.html",
    ],
)
def test_other_addresses_are_not_found(server, path):
    assert server.answer(path)[0] == 404


@pytest.mark.parametrize("path", ["../server.py", "view.js/../../server.py", "%2e%2e/server.py"])
def test_no_other_file_is_served(server, path):
    assert ask(server, path)[0].status == 404


def test_it_answers_this_machine_and_those_with_the_secret_only(server):
    assert server.server_address[0] == "127.0.0.1"
    assert ask(server, "about.json", secret="guess")[0].status == 404
    assert ask(server, "about.json", host=f"evil.example:{server.server_port}")[0].status == 404
    assert ask(server, "about.json", host=f"localhost:{server.server_port}")[0].status == 200


def test_nothing_is_loaded_from_outside(server):
    for name in ("page.html", "view.css", "view.js"):
        content = (files("tomo_polysplat.viewer") / name).read_text(encoding="utf-8")
        assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", content), name
    policy = ask(server, "")[0].headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'") and "connect-src 'self'" in policy


def test_volumes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="b: expected shape"):
        shown_of(result(), {"b": np.zeros((5, 7, 8))}, "x")
    with pytest.raises(ValueError, match="b: expected a volume in 1/cm, got 1/mm"):
        shown_of(result(), {"b": result(unit="mm")}, "x")


def test_the_command_shows_files(tmp_path, capsys):
    record = {"fitted": {"scatter": 0.03}}
    result(plan={"calibration": Answer.found(record)}).save(tmp_path / "a.h5")
    result(2.0).save(tmp_path / "b.h5")
    arguments = build_parser().parse_args(["view", str(tmp_path / "a.h5"), str(tmp_path / "b.h5")])
    shown = shown_by(arguments)
    assert list(shown.volumes) == ["tomo-polysplat", "b"]
    assert "About the scanner was found: scatter of 0.03 of the open beam." in shown.html
    assert main(["view", str(tmp_path / "none.h5"), "--no-browser"]) == 2
    assert "none.h5" in capsys.readouterr().err


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_a_browser_shows_it(server):
    """The slices are drawn where their canvas says which ones they are."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000", "--dump-dom"]
    page = subprocess.run([BROWSER, *options, server.url], capture_output=True, text=True, timeout=60).stdout
    z, y, x = server.shown.point
    for axis, index in enumerate((z, y, x)):
        assert f'data-shown="1,0:{axis}:{index}"' in page, "FDK to the left, ours to the right"
    assert re.search(rf"z {z}, y {y}, x {x}: tomo-polysplat [0-9.]+, FDK [0-9.]+ 1/cm", page)
