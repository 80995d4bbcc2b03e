"""Captions from a server: faults, resuming, the same table whatever the order, no key on disk."""

import json
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from forge.damage import inflate
from forge.errors import fails
from forge.servers import FakeServer
from palpate.captions import StoppedError, caption
from palpate.captions.server import Server
from palpate.cli import main
from palpate.core import PalpateError

TOP = Path(__file__).resolve().parents[1]
KEY = "sk-planted-7c1f"


@pytest.fixture
def data(small_manifest, tmp_path):
    """12 contacts of four frames, with photos of different bytes."""
    small_manifest.save(tmp_path / "tag" / "manifest.parquet")
    return tmp_path / "tag"


@pytest.fixture
def quick(monkeypatch):
    """Pauses between tries of a hundredth of a second."""
    init = Server.__init__
    monkeypatch.setattr(Server, "__init__", lambda *a, **k: init(*a, **{"pause": 0.01} | k))


def describe(data, output, server, **options):
    return caption(data, output, server=server.url, **options)


def table_of(output):
    return (output / "captions.parquet").read_bytes()


def logged(output):
    return [json.loads(line) for line in (output / "replies.jsonl").read_text().splitlines()]


def test_one_photo_a_contact_and_its_caption_for_all_frames(data, tmp_path):
    with FakeServer() as server:
        result = describe(data, tmp_path / "c", server)
    assert server.count == 12
    assert result.record["model"] == server.model
    assert result.record["counts"]["samples"] == 48
    assert result.record["tokens"] == {"in": 12 * 700, "out": 12 * 30}
    table = result.table.with_columns(frame=pl.col("id").str.split("/").list.get(1).cast(pl.Int64))
    contacts = table.group_by(pl.col("id").str.split("/").list.get(0), pl.col("frame") // 100)
    assert contacts.agg(pl.col("text").n_unique())["text"].to_list() == [1] * 12
    middle = {row["id"].split("/")[1] for row in logged(tmp_path / "c")}
    assert middle == {"2", "102"}, "the middle frames"


def test_requests_have_the_schema_at_the_top_and_an_image_without_metadata(data, tmp_path):
    with FakeServer() as server:
        describe(data, tmp_path / "c", server, body={"temperature": None, "top_k": 1}, seed=7)
    payload = server.payloads[0]
    assert payload["response_format"]["type"] == "json_schema"
    assert payload["response_format"]["json_schema"]["strict"] is True
    assert (payload["seed"], payload["top_k"], "temperature" in payload) == (7, 1, False)
    text, image = payload["messages"][0]["content"]
    assert "hand" in text["text"]
    assert image["image_url"]["url"].startswith("data:image/jpeg;base64,")


@pytest.mark.parametrize(("per", "count"), [("frame", 48), ("contact", 12), ("object", 0)])
def test_units(data, tmp_path, per, count):
    with FakeServer() as server:
        if count:
            describe(data, tmp_path / "c", server, per=per)
        else:
            fails("none is known", describe, data, tmp_path / "c", server, per=per)
    assert server.count == count


PROXY = (200, {"error": {"message": "busy", "code": "502"}})
FAULTS = {
    "hanging": ("hang", 13, 12, ()),
    "a page of a proxy": ("page", 13, 12, ()),
    "an error of a proxy": (PROXY, 13, 12, ()),
    "busy": ("429 0", 13, 12, ()),
    "busy without a time": ("429", 13, 12, ()),
    "failing": ("500", 13, 12, ()),
    "reset in the middle of the body": ("reset", 13, 12, ()),
    "truncated": ("truncated", 13, 12, ()),
    "prose": ("prose", 13, 12, ()),
    "wrapped": ("fenced", 12, 12, ("schema-ignored",)),
    "refusing": ("refusal", 12, 11, ("refusal",)),
    "flagged by the server": ("flagged", 12, 11, ("refusal",)),
    "hidden": ("hidden", 12, 12, ("surface-hidden",)),
}


@pytest.mark.parametrize("name", FAULTS)
def test_one_fault_is_repaired_or_flagged(data, tmp_path, quick, name):
    fault, requests, texts, flags = FAULTS[name]
    with FakeServer(lambda number: fault if number == 5 else None) as server:
        result = describe(data, tmp_path / "c", server, concurrency=1, timeout=0.5)
    counts = result.record["counts"]
    assert (server.count, counts["texts"]) == (requests, texts)
    assert tuple(counts["flags"]) == flags


@pytest.mark.parametrize(("fault", "why"), [("truncated", "truncated"), ("prose", "invalid")])
def test_replies_that_are_asked_for_again_are_kept_with_the_reason(data, tmp_path, fault, why):
    with FakeServer(lambda number: fault if number in (5, 6) else None) as server:
        result = describe(data, tmp_path / "c", server, concurrency=1)
        rows = logged(tmp_path / "c")
        assert [row["unused"] for row in rows] == [None] * 4 + [why] * 2 + [None] * 8
        assert len({row["key"] for row in rows[4:7]}) == 1
        assert rows[4]["raw"] != rows[6]["raw"]
        assert result.record["unused"] == {why: 2}
        assert result.record["tokens"] == {"in": 14 * 700, "out": 14 * 30}
        again = describe(data, tmp_path / "c", server)
    assert (server.count, again.record) == (14, result.record)


def test_a_run_that_goes_on_asks_about_no_photo_that_has_an_answer(data, tmp_path):
    """Cut after the first of two tries, it begins with that photo's first, to the same table."""
    with FakeServer(lambda number: "truncated" if number in (5, 6) else None) as server:
        describe(data, tmp_path / "c", server, concurrency=1)
        whole, log = table_of(tmp_path / "c"), tmp_path / "c" / "replies.jsonl"
        log.write_text("".join(log.read_text().splitlines(keepends=True)[:5]))
        first = server.payloads[4]
        server.count, server.payloads = 4, []
        result = describe(data, tmp_path / "c", server, concurrency=1)
    assert len(server.payloads) == 10
    assert server.payloads[0] == first
    assert server.payloads[1]["max_tokens"] == 2 * first["max_tokens"]
    assert server.payloads[1]["seed"] == first["seed"] + 1
    assert (result.record["unused"], table_of(tmp_path / "c")) == ({"truncated": 3}, whole)


def test_what_stays_unusable_is_flagged_and_kept(data, tmp_path):
    with FakeServer(lambda number: "truncated") as server:
        result = describe(data, tmp_path / "c", server)
        assert result.record["counts"]["flags"] == {"truncated": 12}
        assert server.count == 36, "three tries each"
        assert [p["max_tokens"] for p in server.payloads[:1]] == [300]
        assert max(p["max_tokens"] for p in server.payloads) == 1200
        assert describe(data, tmp_path / "c", server).record["counts"]["texts"] == 0
    assert server.count == 36, "what was answered is not asked again"
    assert result.record["unused"] == {"truncated": 24}
    assert result.record["tokens"]["out"] == 36 * 30


def test_the_same_table_whatever_the_order(data, tmp_path):
    with FakeServer() as server:
        describe(data, tmp_path / "a", server, concurrency=1)
    late = lambda number: "429 0.05" if number % 3 == 0 else "other-model"
    with FakeServer(late, delay=0.02) as server:
        result = describe(data, tmp_path / "b", server, concurrency=3)
    assert server.busiest == 3, "no more at once than asked for"
    assert result.record["answered_as"] == {"other/model": 12}
    lines = [(tmp_path / name / "replies.jsonl").read_text().splitlines() for name in "ab"]
    assert lines[0] != lines[1]
    assert table_of(tmp_path / "a") == table_of(tmp_path / "b")


def test_a_torn_last_line_is_dropped_and_another_line_is_an_error(data, tmp_path):
    with FakeServer() as server:
        describe(data, tmp_path / "c", server)
        whole, log = table_of(tmp_path / "c"), tmp_path / "c" / "replies.jsonl"
        log.write_bytes(log.read_bytes()[:-25])
        describe(data, tmp_path / "c", server)
        assert server.count == 13
        assert table_of(tmp_path / "c") == whole
        assert all(json.loads(line) for line in log.read_text().splitlines())
        inflate(log)
        tracemalloc.start()
        describe(data, tmp_path / "c", server)
        assert tracemalloc.get_traced_memory()[1] < 1 << 30
        tracemalloc.stop()
        assert server.count == 13
        log.write_text('{"format": "mine"}\n')
        fails("another line 1", describe, data, tmp_path / "c", server)


RUN = "import sys; from palpate.cli import main; sys.exit(main(sys.argv[1:]))"


def start(*args):
    env = os.environ | {"PYTHONPATH": str(TOP / "src")}
    return subprocess.Popen(
        [sys.executable, "-c", RUN, *map(str, args)],
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, pytest.param(3, marks=pytest.mark.nightly)])
def test_killed_it_repeats_at_most_what_was_in_flight(kills, data, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PALPATE_CAPTION_KEY", KEY)
    with FakeServer(delay=0.05, key=KEY) as server:
        options = ["--server", server.url, "--per", "frame", "--concurrency", "3"]
        command = ["caption", data, "-o", tmp_path / "c", *options]
        for kill in range(kills):
            running, before = start(*command), server.count
            while server.count < before + 8:
                assert running.poll() is None, running.stdout.read()
                time.sleep(0.01)
            running.send_signal(signal.SIGKILL)
            running.communicate()
            assert not (tmp_path / "c" / "captions.parquet").exists(), kill
        assert main([*map(str, command)]) == 0
        assert sum(server.images.values()) - 48 <= kills * 3
        assert len(server.images) == 48
        server.delay = 0
        assert main([*map(str, [*command[:3], tmp_path / "d", *options])]) == 0
    assert KEY not in "".join(capsys.readouterr())
    assert table_of(tmp_path / "c") == table_of(tmp_path / "d")
    for path in tmp_path.rglob("*"):
        assert not path.is_file() or KEY.encode() not in path.read_bytes(), path


def test_two_runs_on_one_output(data, tmp_path):
    with FakeServer(delay=0.3) as server:
        command = ["caption", data, "-o", tmp_path / "c", "--server", server.url]
        first = start(*command, "--concurrency", "1")
        while not server.count:
            time.sleep(0.01)
        fails("another run writes", describe, data, tmp_path / "c", server)
        first.kill()
        first.communicate()


def test_ctrl_c_ends_at_once_although_a_request_hangs(data, tmp_path):
    with FakeServer(delay=30) as server:
        running = start("caption", data, "-o", tmp_path / "c", "--server", server.url, "-q")
        while not server.count:
            time.sleep(0.01)
        running.send_signal(signal.SIGINT)
        output = running.communicate(timeout=5)[0]
    assert running.returncode == 130
    assert "Run the same command again" in output


@pytest.mark.parametrize("fault", ["500", "reset"])
def test_a_server_that_dies_midway_keeps_what_is_done(data, tmp_path, quick, fault, capsys):
    with FakeServer(lambda number: fault if number > 5 else None) as server:
        with pytest.raises(StoppedError, match="5 of 12 photos are described") as caught:
            describe(data, tmp_path / "c", server, concurrency=1)
        assert (caught.value.answered, caught.value.total) == (5, 12)
        args = ["caption", str(data), "-o", str(tmp_path / "d"), "--server", server.url, "-q"]
        server.count = 0
        assert main([*args, "--concurrency", "1"]) == 1
        assert "run the same command again" in capsys.readouterr().err
        server.faults = lambda number: None
        assert main(args) == 0
    assert len((tmp_path / "d" / "replies.jsonl").read_text().splitlines()) == 12


def test_photos_that_are_rejected_are_no_matter_of_the_server_in_any_order(data, tmp_path):
    """Half of them are, first; with 48 photos and at most 16 probes, and in the next run alone."""
    with FakeServer(lambda number: "413" if number <= 15 else None) as server:
        result = describe(data, tmp_path / "c", server, per="frame", concurrency=1)
        assert (server.count, result.record["counts"]["texts"]) == (48, 33)
        server.faults = lambda number: "413"
        for _ in range(2):
            again = describe(data, tmp_path / "c", server, per="frame")
            assert (len(again.problems), again.record["counts"]["texts"]) == (15, 33)
        server.count = 0
        fails("must take the requests", describe, data, tmp_path / "d", server, per="frame")
    assert server.count == 16


def reply(content, **fields):
    message = {"message": {"content": content}, "finish_reason": "stop"}
    return 200, {"choices": [message], **fields}


GOOD = '{"adjectives": ["rough", "dry", "hard"], "surface_visible": true}'
ODD = {
    "half a character": (reply(GOOD.replace("dry", "dry\\ud800")), "rough, dry?, hard"),
    "half a character outside": (reply(GOOD.replace("dry", "dry\ud800")), "rough, dry?, hard"),
    "the end of a thought alone": (reply(f"It is {{soft}}.</think>{GOOD}"), "rough, dry, hard"),
    "a key that is a word": (reply(GOOD, model="a rough one"), "rough, dry, hard"),
    "no end": (reply(GOOD + "rough " * 50_000), "rough, dry, hard"),
}


@pytest.mark.parametrize("name", ODD)
def test_an_odd_reply_is_read_and_the_folder_stays_readable(data, tmp_path, name, monkeypatch):
    monkeypatch.setenv("PALPATE_CAPTION_KEY", "rough")
    fault, text = ODD[name]
    with FakeServer(lambda number: fault if number == 3 else None) as server:
        first = describe(data, tmp_path / "c", server, concurrency=1)
        assert text in first.table["text"].to_list()
        whole = table_of(tmp_path / "c")
        assert max(len(row["raw"]) for row in logged(tmp_path / "c")) <= 20_000
        assert describe(data, tmp_path / "c", server).record == first.record
    assert (server.count, table_of(tmp_path / "c")) == (12, whole)


def test_no_usable_caption_at_all_is_noted_and_exits_1(data, tmp_path, capsys):
    with FakeServer(lambda number: "refusal") as server:
        assert main(["caption", str(data), "-o", str(tmp_path / "c"), "--server", server.url]) == 1
    output = capsys.readouterr()
    assert "No caption can be used: refusal 12" in output.out + output.err
    assert "Next:" not in output.out


def test_single_requests_that_the_server_does_not_take_are_listed(data, tmp_path, capsys):
    with FakeServer(lambda number: "413" if number in (4, 6) else None) as server:
        args = ["caption", data, "-o", tmp_path / "c", "--server", server.url, "-q"]
        assert main([*map(str, args), "--concurrency", "1"]) == 1
        assert "Without a caption: 2" in capsys.readouterr().out
        table = pl.read_parquet(tmp_path / "c" / "captions.parquet")
        assert table["flags"].list.contains("rejected").sum() == 8
        assert table["text"].null_count() == 8
        assert main([*map(str, args)]) == 0, "the same command asks again"
    assert server.count == 14
    rows = [row for row in logged(tmp_path / "c") if row["unused"] == "rejected"]
    assert [row["raw"] for row in rows] == ["status 413: fault 413"] * 2


#: Arguments that are wrong, and what the error must say.
WRONG = {
    "no URL": ("--server localhost:8000/v1", "http://HOST:PORT"),
    "password in the URL": ("--server http://me:secret@host/v1", "without password"),
    "refused": ("--server http://127.0.0.1:9/v1 --model m", "Connection refused"),
    "refused, no model": ("--server http://127.0.0.1:9/v1", "Connection refused"),
    "path": ("--server {url}/x --model m", "http://HOST:PORT/v1"),
    "path, no model": ("--server {url}/x", "Name it, or give the base"),
    "model": ("--server {url} --model gpt", "It has fake/vlm-7b"),
    "body": ("--server {url} --body [1]", "a JSON object"),
    "nothing": ("", "server or template. Got none"),
    "two": ("--server {url} --template", "server or template. Got both"),
    "concurrency": ("--server {url} --concurrency 0", "--concurrency must be a positive number"),
    "timeout": ("--server {url} --timeout -1", "--timeout must be a positive number"),
    "reply": ("--server {url} --max-tokens 0", "--max-tokens must be a positive number"),
    "prompt": ("--server {url} --prompt none.txt", "touch-sentence/1"),
    "format": ("--template {{frame:q}}", "--template must be a text with columns in braces"),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_arguments_are_one_line_and_exit_2(data, tmp_path, name, capsys):
    options, says = WRONG[name]
    with FakeServer() as server:
        args = options.format(url=server.url).split()
        started = time.perf_counter()
        assert main(["caption", str(data), "-o", str(tmp_path / "c"), "-q", *args]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert "secret" not in error
    assert len(error.splitlines()) == 1
    assert time.perf_counter() - started < 3


@pytest.mark.parametrize("given", ["", "wrong-key"])
def test_a_wrong_key_is_named_by_its_variable_and_never_shown(
    data, tmp_path, given, monkeypatch, capsys
):
    monkeypatch.setenv("PALPATE_CAPTION_KEY", given)
    with FakeServer(key=KEY) as server:
        args = ["caption", str(data), "-o", str(tmp_path / "c"), "--server", server.url, "-q"]
        assert main(args) == 2
    error = capsys.readouterr().err
    assert "environment variable PALPATE_CAPTION_KEY" in error
    assert "wrong-key" not in error


@pytest.mark.parametrize("field", ["error", "detail", "cause", "model", "id", "words"])
def test_a_key_that_comes_back_in_escapes_is_not_kept(data, tmp_path, monkeypatch, capsys, field):
    key = "sk/planted/7c1f"
    monkeypatch.setenv("PALPATE_CAPTION_KEY", key)
    said = "".join(f"\\u{ord(sign):04x}" for sign in key)
    body = {field: "SAID"} | {"error": {"message": "SAID"}}
    if field not in ("error", "detail", "cause"):
        body = reply(GOOD + " SAID" * (field == "words"), **body | {"error": 0})[1]
    for escaped in (said, key, key.replace("/", "\\/")):
        fault = json.dumps(body).replace("SAID", escaped).encode()
        with FakeServer(
            lambda number, fault=fault: (400, fault) if number % 2 else (200, fault)
        ) as s:
            main(["caption", str(data), "-o", str(tmp_path / "c"), "--server", s.url, "-q"])
    shown = capsys.readouterr()
    assert key not in shown.out + shown.err
    for path in (tmp_path / "c").iterdir():
        assert key.encode() not in path.read_bytes()


@pytest.mark.parametrize(
    ("fault", "got"),
    [
        ("400", "fault 400"),
        ("404", "`server` must be an OpenAI-compatible API"),
        ("no-completion", "choices"),
        ("page", "no JSON: '<html>'"),
        ((200, b""), "no JSON: ''"),
        ((200, b"no gzip", {"Content-Encoding": "gzip"}), "DecodingError"),
        ((200, {"error": {"message": "upstream is busy", "code": 502}}), "502: upstream is busy"),
        ((200, {"error": "no images"}), "status 400: no images"),
        ((429, {}, {"Retry-After": "86400"}), "86400 s.*fewer requests at once"),
    ],
)
def test_all_requests_rejected_is_an_error_and_not_a_table(data, tmp_path, quick, fault, got):
    with FakeServer(lambda number: fault) as server, pytest.raises(PalpateError, match=got):
        describe(data, tmp_path / "c", server)
    assert not (tmp_path / "c" / "captions.parquet").exists()


def test_photos_that_are_none_are_listed_and_cost_no_request(data, tmp_path, small_manifest):
    paths = small_manifest.paths("vision")
    bad = paths[2:30:4]
    for path in bad[:4]:
        path.write_bytes(b"")  # of equal bytes
    bad[4].write_bytes(b"no image")
    for path in bad[5:]:
        path.unlink()
    os.mkfifo(bad[6])
    with FakeServer() as server:
        result = describe(data, tmp_path / "c", server)
    assert server.count == 5
    assert [problem.where for problem in result.problems] == sorted(map(str, bad))
    assert result.record["counts"]["flags"] == {"bad-image": 7}


def test_samples_without_photos(small_manifest, tmp_path):
    bare = replace(
        small_manifest, table=small_manifest.table.with_columns(vision=None, contact=None)
    )
    with FakeServer() as server, pytest.raises(PalpateError, match="must have vision images"):
        caption(bare, tmp_path / "c", server=server.url)


def test_equal_photos_are_asked_about_once(data, tmp_path, small_manifest):
    first = small_manifest.paths("vision")[0].read_bytes()
    for path in small_manifest.paths("vision"):
        path.write_bytes(first)
    with FakeServer() as server:
        result = describe(data, tmp_path / "c", server)
    assert (server.count, result.record["counts"]["different"]) == (1, 1)


def test_a_dry_run_sends_and_writes_nothing(data, tmp_path, quick):
    with FakeServer() as server:
        estimate = describe(data, tmp_path / "c", server, dry_run=True)
        assert (estimate.photos, estimate.requests, server.count) == (12, 12, 0)
        assert not (tmp_path / "c").exists()
        server.faults = lambda number: "500" if number > 4 else None
        with pytest.raises(StoppedError):
            describe(data, tmp_path / "c", server, concurrency=1)
        estimate = describe(data, tmp_path / "c", server, dry_run=True)
    assert str(estimate) == "12 photos need 8 requests; no photo was sent"


def test_a_missing_client_is_one_line(data, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "httpx2", None)
    monkeypatch.delitem(sys.modules, "palpate.captions.server")
    args = ["caption", str(data), "-o", str(tmp_path / "c"), "--server", "http://localhost:1/v1"]
    assert main(args) == 2
    assert "pip install -e '.[caption]'" in capsys.readouterr().err


def test_nothing_is_sent_after_a_call_that_failed(data, tmp_path):
    """Threads that wait to try again send nothing more."""
    faults = {1: (401, {"error": {"message": "no"}})}
    with FakeServer(lambda n: faults.get(n, "503")) as server:
        fails("accepts the key", describe, data, tmp_path / "c", server, per="frame", concurrency=4)
        sent = server.count
        time.sleep(2.5)  # they would try again after one second
        assert server.count <= sent + 3, "those in flight"
    assert server.count < 10
