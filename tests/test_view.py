"""``palpate view``: what is listed, what is served, and the page in a browser."""

import importlib
import json
import os
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image

from forge.errors import fails
from palpate.cli import main
from palpate.core import Split
from palpate.report.records import GalleryItem
from palpate.report.results import Results, SampleRef
from palpate.sim import WorldOptions, write_world
from palpate.viewing import contents

ARTIFACTS = Path(os.environ.get("PALPATE_ARTIFACTS", "/tmp"))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view") / "tag"
    options = WorldOptions(size=32, materials=2, objects_per_material=2, contacts_per_video=2)
    write_world(folder, options)
    return folder


@pytest.fixture(scope="module")
def served(world):
    """The link of a server that is started as a user starts it."""
    words = ["view", str(world), "--split", str(world / "splits" / "Orig.json"), "--port", "0"]
    code = f"import sys; from palpate.cli import main; sys.exit(main({words!r}))"
    with subprocess.Popen([sys.executable, "-u", "-c", code], stdout=subprocess.PIPE) as server:
        line = server.stdout.readline().decode()
        yield re.search(r"http://127\.0\.0\.1:\d+/\?token=[\w-]+", line)[0]
        server.terminate()
        assert server.wait(30) in (0, -15)


def get(link, path, **values):
    base, _, token = link.partition("?token=")
    query = "&".join(f"{k}={v}" for k, v in ({"token": token} | values).items())
    with urllib.request.urlopen(f"{base}{path}?{query}", timeout=60) as answer:
        return answer.status, answer.headers, answer.read()


def status(link, path, **values):
    try:
        return get(link, path, **values)[0]
    except urllib.error.HTTPError as error:
        return error.code


def test_samples_are_listed_by_recording_with_their_part(world):
    shown = contents(world, split=world / "splits" / "Orig.json")
    split = Split.load(world / "splits" / "Orig.json")
    assert {entry.id: entry.part for entry in shown.entries} == dict(split.parts)
    recordings = shown.to_json()["recordings"]
    assert sum(len(r["samples"]) for r in recordings) == len(split)
    assert {"vision", "tactile", "background"} <= set(recordings[0]["samples"][0]["kinds"])
    assert str(world) not in str(recordings)  # no path


def test_exchanged_sides_of_a_recording_are_suspicious(world, tmp_path):
    import palpate as pp

    manifest = pp.load(world)
    first = manifest.table["video"][0]
    rows = [dict(row) for row in manifest.table.iter_rows(named=True)]
    for row in rows:
        if row["video"] == first:
            row["vision"], row["tactile"] = row["tactile"], row["vision"]
    shown = contents(pp.Manifest.from_rows(rows, manifest.root, more=["depth"]))
    assert set(shown.suspicious) == {first}


def test_results_show_their_gallery(tmp_path):
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a.png")
    file = str(tmp_path / "a.png")
    item = GalleryItem(SampleRef("s", "v", tactile=file), file, method="ours")
    Results("Scores", gallery=[item]).save(tmp_path / "scores.json")
    shown = contents(tmp_path / "scores.json")
    assert [(e.recording, e.part, sorted(e.images)) for e in shown.entries] == [
        ("v", "ours", ["generated", "tactile"])
    ]
    Results("Scores").save(tmp_path / "none.json")
    fails("There must be images to look at", contents, tmp_path / "none.json")


def test_a_port_in_use_and_a_missing_extra_are_one_line(world, monkeypatch, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["view", str(world), "--model", "none", "--port", port]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"port {port}" in error
    assert "choose another port" in error
    for name in [n for n in sys.modules if n.startswith(("starlette", "palpate.viewing"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "starlette", None)
    monkeypatch.setitem(sys.modules, "starlette.applications", None)
    assert main(["view", str(world)]) == 2
    error = capsys.readouterr().err.strip()
    assert "pip install -e '.[app]'" in error
    assert "\n" not in error


@pytest.mark.slow
def test_the_link_opens_four_routes_and_no_file(served):
    assert status(served, "") == 200
    assert status(served, "data.json") == 200
    assert status(served, "data.json", token="guess") == 403
    assert status(served, "image", k=0, kind="tactile", token="") == 403
    assert status(served, "image", k=0, kind="tactile") == 200
    for k, kind in ((-1, "tactile"), (10**6, "tactile"), (0, "/etc/passwd"), ("x", "vision")):
        assert status(served, "image", k=k, kind=kind) == 404
    assert status(served, "manifest.parquet") == 404
    policy = get(served, "")[1]["Content-Security-Policy"]
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy


def test_a_request_says_what_the_pipeline_is_asked_for(world):
    asked = {}

    class Pipeline:
        contact = object()

        def generate(self, photo, **options):
            asked.update(options, size=photo.size)
            return np.zeros((1, 4, 4, 3), np.uint8)

    shown = contents(world)
    server = importlib.import_module("palpate.viewing.server")._View(shown, "m", "t")
    server.pipeline = Pipeline()
    k = next(k for k, entry in enumerate(shown.entries) if "background" in entry.images)
    photo = next((world / "dataset").glob("*/video_frame/*.jpg")).read_bytes()
    settings = {"token": "t", "gel": str(k), "x": "0.2", "y": "0.7", "strength": "0.9"}
    made = server._touched(photo, settings | {"shear_x": "1", "shear_y": "-2"})
    assert made.startswith(b"\x89PNG")
    assert (asked["at"], asked["strength"], asked["shear"]) == ((0.2, 0.7), 0.9, (1.0, -2.0))
    assert asked["gel"] == shown.entries[k].images["background"]
    server._touched(photo, {"token": "t"})
    assert asked["gel"] is None


def wait(page, expression, argument=None):
    """Until an expression holds; the page's policy forbids what playwright waits by."""
    for _ in range(600):
        if page.evaluate(expression, argument):
            return
        time.sleep(0.2)
    raise AssertionError(expression)


@pytest.mark.slow
@pytest.mark.browser
def test_a_person_browses_recordings_and_touches_a_photo(served, world, chromium, tmp_path):
    photo = next((world / "dataset").glob("*/video_frame/*.jpg"))
    page = chromium.new_page(viewport={"width": 390, "height": 800})
    errors = []
    page.on(
        "console", lambda message: errors.append(message.text) if message.type == "error" else 0
    )
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(served)
    page.wait_for_selector("figure img")
    options = page.locator("#recording option")
    assert options.count() == len({p.parent for p in (world / "dataset").glob("*/video_frame")})
    loaded = "[...document.querySelectorAll('figure img')].slice(0, 2).every(i => i.naturalWidth)"
    wait(page, loaded)
    first = page.locator("figcaption").first.inner_text()
    page.select_option("#recording", index=1)
    assert page.locator("figcaption").first.inner_text() != first
    assert page.locator("figure.train, figure.test").count()
    page.set_input_files("#photo", str(photo))
    seen = "document.getElementById('touch').naturalWidth > 0"
    wait(page, seen)
    before = page.get_attribute("#touch", "src")
    page.select_option("#gel", index=1)
    wait(page, "b => document.getElementById('touch').src !== b", before)
    assert not page.evaluate("document.documentElement.scrollWidth > innerWidth")
    page.set_input_files("#photo", files=[{"name": "x", "mimeType": "", "buffer": b"no image"}])
    wait(page, "document.getElementById('said').textContent.includes('image')")
    page.screenshot(path=ARTIFACTS / "view.png")
    assert [e for e in errors if "400" not in e] == []
    page.close()


@pytest.mark.slow
@pytest.mark.browser
def test_place_strength_and_shear_are_dragged_where_the_pipeline_knows_contacts(
    served, world, chromium
):
    page, asked = chromium.new_page(), []
    data = json.loads(get(served, "data.json")[2]) | {"contacts": True}
    png = get(served, "image", k=0, kind="tactile")[2]

    def touched(route):
        asked.append(parse_qs(urlsplit(route.request.url).query))
        route.fulfill(body=png, content_type="image/jpeg")

    page.route("**/data.json*", lambda route: route.fulfill(json=data))
    page.route("**/touch*", touched)
    page.goto(served)
    page.wait_for_selector("figure img")
    assert page.locator("#contacts").is_visible()
    page.set_input_files("#photo", str(next((world / "dataset").glob("*/video_frame/*.jpg"))))
    page.wait_for_selector("#touch:visible")
    assert (asked[-1]["x"], asked[-1]["strength"]) == (["0.5"], ["0.5"])
    box = page.locator("#gelboard").bounding_box()
    page.mouse.move(box["x"] + 128, box["y"] + 128)
    page.mouse.down()
    page.mouse.move(box["x"] + 64, box["y"] + 192, steps=4)
    page.mouse.up()
    page.locator("[name=shear_x]").fill("2")
    page.locator("[name=strength]").fill("0.9")
    with page.expect_response("**/touch*strength=0.9*"):
        page.locator("[name=strength]").dispatch_event("change")
    last = asked[-1]
    assert float(last["x"][0]) == pytest.approx(0.25, abs=0.02)
    assert float(last["y"][0]) == pytest.approx(0.75, abs=0.02)
    assert (last["shear_x"], last["strength"]) == (["2"], ["0.9"])
    page.close()
