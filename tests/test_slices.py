"""Slices: the same for every process, finished once, read as one; and what may go wrong."""

import json
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from functools import partial

import numpy as np
import polars as pl
import pytest
from PIL import Image

import palpate as pp
from forge.models import make_pipeline
from forge.pictures import write_photos
from palpate.cli import main
from palpate.core import PalpateError, locked
from palpate.data.manifest import Manifest
from palpate.data.samples import read_samples
from palpate.data.slices import Slice, parts_in, whole_parts
from palpate.diffusion.generation import generate
from palpate.encoders import embed as embedding
from palpate.encoders.embed import embed
from palpate.encoders.embedded import embed_dataset
from palpate.encoders.encoder_set import EncoderSet

MINI = "palpate/handcrafted"


@contextmanager
def fails(*words):
    """What is inside raises a mistake of the user, with these words."""
    with pytest.raises(PalpateError) as caught:
        yield
    for word in words:
        assert word in str(caught.value)


def touches(root, videos=9, frames=4, seed=0):
    """A manifest of small touches with backgrounds; every video has its own number of frames."""
    rng, rows = np.random.default_rng(seed), []
    for v in range(videos):
        gel = rng.integers(90, 120, (24, 32, 3), np.uint8)
        for f in range(frames + v % 3):
            image = np.clip(gel + rng.normal(0, 12, gel.shape), 0, 255).astype(np.uint8)
            for name, pixels in (("touch", image), ("gel", gel)):
                path = root / f"v{v}" / f"{name}{f}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                Image.fromarray(pixels).save(path)
            rows.append(
                {"id": f"v{v}/{f}", "video": f"v{v}", "frame": f, "material": "ab"[v % 2]}
                | {"tactile": f"v{v}/touch{f}.png", "background": f"v{v}/gel{f}.png"}
            )
    return Manifest.from_rows(rows, root)


@pytest.fixture
def palpate(capsys):
    """Run a command: exit status, standard output and error."""

    def run(line):
        status = main(shlex.split(line))
        return status, *capsys.readouterr()

    return run


@pytest.fixture
def data(tmp_path):
    return touches(tmp_path / "data")


def made(data, output, of, encoder=MINI):
    return [embed_dataset(data, encoder, output, slice=f"{k + 1}/{of}") for k in range(of)]


def test_slices_are_whole_recordings_and_an_added_one_changes_its_own_alone(tmp_path):
    few, more = (touches(tmp_path / str(n), videos=n) for n in (40, 41))
    slices = [Slice(k + 1, 5) for k in range(5)]
    parts = [s.take(few) for s in slices]
    assert sorted(i for p in parts for i in p.ids) == sorted(few.ids)
    videos = [{*p.column("video")} for p in parts]
    assert sum(map(len, videos)) == 40
    changed = [s.take(more).ids != p.ids for s, p in zip(slices, parts, strict=True)]
    assert sum(changed) == 1
    counts = [len(p) for p in parts]
    assert slices[0].spread(few) == f"{min(counts)} to {max(counts)} samples a slice"
    assert Slice.parse("2/3") == Slice(2, 3)
    assert Slice.parse(None).take(few).ids == few.ids


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "1/", "a/b", "-1/3", "1/0"])
def test_a_slice_is_a_number_and_how_many(text):
    with fails("must be i/n, with i from 1 to n", text):
        Slice.parse(text)


def test_parts_are_bit_equal_to_the_whole_and_scored_as_the_images(data, tmp_path):
    other = touches(tmp_path / "other", seed=1)
    for name, source in (("real", data), ("drawn", other)):
        embed_dataset(source, MINI, tmp_path / name)
        made(source, tmp_path / f"{name} by 4", 4)
        whole, parts = (read_samples(tmp_path / n, n) for n in (name, f"{name} by 4"))
        assert np.array_equal(whole.rows, parts.rows)
        assert whole.ids == parts.ids == sorted(source.ids)
    assert isinstance(whole.rows, np.memmap)
    common = {"companions": ["fid", "kid"], "permutations": 19}
    of_images = pp.score(other, data, encoder=MINI, **common)
    by_one = pp.score(tmp_path / "drawn", tmp_path / "real", names=["generated"], **common)
    by_four = pp.score(
        tmp_path / "drawn by 4", tmp_path / "real by 4", names=["generated"], **common
    )
    for a, b, c in zip(of_images.scores, by_one.scores, by_four.scores, strict=True):
        assert (a.measure, a.encoder) == (b.measure, b.encoder) == (c.measure, c.encoder)
        assert b.value == c.value
        assert b.interval == c.interval
        assert a.value == (b.value and pytest.approx(b.value, rel=1e-12, abs=1e-12))


def test_probe_reads_parts_as_images(data, tmp_path):
    split = pp.split(data, val=0)
    made(data, tmp_path / "parts", 3)
    of_images = pp.probe(data, split, encoder=MINI, top=())
    of_parts = pp.probe(tmp_path / "parts", split)
    assert [s.value for s in of_parts.scores] == [s.value for s in of_images.scores]
    with fails("must go with images, and not with embeddings"):
        pp.probe(tmp_path / "parts", split, encoder=MINI)


def test_only_changed_slices_are_made_anew(tmp_path):
    grown = touches(tmp_path / "data", videos=10)
    data = Manifest(grown.table.filter(pl.col("video") != "v9"), grown.root)
    assert [part.new for part in made(data, tmp_path / "parts", 4)] == [True] * 4
    assert [part.new for part in made(data, tmp_path / "parts", 4)] == [False] * 4
    own = Slice(1, 4).numbers(["v9"])["v9"]
    again = made(grown, tmp_path / "parts", 4)
    assert [part.new for part in again] == [k + 1 == own for k in range(4)]
    assert read_samples(tmp_path / "parts", "parts").ids == sorted(grown.ids)
    image = grown.path("v0/touch0.png")
    stat = image.stat()
    os.utime(image, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    own = Slice(1, 4).numbers(["v0"])["v0"]
    again = made(grown, tmp_path / "parts", 4)
    assert [part.new for part in again] == [k + 1 == own for k in range(4)]


def test_parts_of_other_states_of_the_data_are_not_read_together(data, tmp_path):
    made(data, tmp_path / "parts", 2)
    fewer = Manifest(data.table[:-1], data.root)
    number = next(k for k in (1, 2) if Slice(k, 2).take(fewer).ids != Slice(k, 2).take(data).ids)
    embed_dataset(fewer, MINI, tmp_path / "parts", slice=f"{number}/2")
    with fails("made of the same data", "where other data were read", "--slice"):
        whole_parts(tmp_path / "parts")
    made(fewer, tmp_path / "parts", 2)
    assert read_samples(tmp_path / "parts", "parts").ids == sorted(fewer.ids)


def test_a_missing_part_is_named_with_its_command(data, tmp_path):
    made(data, tmp_path / "parts", 3)
    shutil.rmtree(tmp_path / "parts" / "part-2-of-3")
    with fails("without 2/3", "Run: palpate embed", "--slice 2/3"):
        pp.score(tmp_path / "parts", tmp_path / "parts")


def test_parts_that_do_not_belong_together_are_refused(data, tmp_path):
    made(data, tmp_path / "parts", 2)
    with fails("of one number of slices", "1/2 and 1/3"):
        embed_dataset(data, MINI, tmp_path / "parts", slice="1/3")
    with fails("with the same settings", "another encoder"):
        embed_dataset(data, "palpate/mini", tmp_path / "parts", slice="1/2")
    (tmp_path / "parts" / "notes.txt").write_text("mine")
    with fails("must hold parts alone", "notes.txt"):
        embed_dataset(data, MINI, tmp_path / "parts", slice="1/2")
    bare = Manifest(data.table.with_columns(pl.lit(None, pl.String).alias("background")), data.root)
    embed_dataset(data, MINI, tmp_path / "real")
    embed_dataset(bare, MINI, tmp_path / "bare")
    embed_dataset(bare, MINI, tmp_path / "next to it", reference=data)
    with fails("of one encoder and kind of background"):
        pp.score(tmp_path / "bare", tmp_path / "real")
    assert pp.score(tmp_path / "next to it", tmp_path / "real", companions=[]).scores


def test_damaged_parts_are_refused(data, tmp_path):
    made(data, tmp_path / "parts", 2)
    record = tmp_path / "parts" / "part-1-of-2" / "part.json"
    record.write_text(record.read_text().replace('"rows": ', '"rows": 1'))
    with fails("damaged"):
        parts_in(tmp_path / "parts")
    made(data, tmp_path / "other", 2)
    file = tmp_path / "other" / "part-1-of-2" / "features.npy"
    file.write_bytes(file.read_bytes()[:-40])
    with fails("features.npy"):
        read_samples(tmp_path / "other", "other")


def test_two_workers_on_one_slice_the_second_leaves(data, tmp_path):
    output = tmp_path / "parts"
    with locked(output / ".part-1-of-2.part"), fails("must be written by one run"):
        embed_dataset(data, MINI, output, slice="1/2")
    assert embed_dataset(data, MINI, output, slice="1/2").new


def test_a_full_disk_midway_leaves_nothing(data, tmp_path, palpate):
    data.save(tmp_path / "manifest.parquet")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
        status, _, err = palpate(
            f"embed {tmp_path}/manifest.parquet --encoder {MINI} -o {tmp_path}/parts -q"
        )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old)
    assert status == 2
    assert "The disk must have room" in err
    assert not [*(tmp_path / "parts").glob("*")]
    assert not [*(tmp_path / "parts").glob(".*")]


@pytest.mark.slow
def test_a_killed_worker_loses_its_own_slice_alone(data, tmp_path):
    data.save(tmp_path / "manifest.parquet")
    command = [sys.executable, "-m", "palpate", "embed", str(tmp_path / "manifest.parquet")]
    command += ["--encoder", MINI, "-o", str(tmp_path / "parts"), "-q", "--slice"]
    subprocess.run([*command, "1/2"], check=True, capture_output=True)
    kept = (tmp_path / "parts/part-1-of-2/features.npy").stat().st_mtime_ns
    worker = subprocess.Popen([*command, "2/2"], stdout=subprocess.DEVNULL)
    while worker.poll() is None and not (tmp_path / "parts/.part-2-of-2.part").exists():
        time.sleep(0.002)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    subprocess.run([*command, "2/2"], check=True, capture_output=True)
    assert (tmp_path / "parts/part-1-of-2/features.npy").stat().st_mtime_ns == kept
    embed_dataset(data, MINI, tmp_path / "whole")
    whole, parts = (read_samples(tmp_path / n, n) for n in ("whole", "parts"))
    assert np.array_equal(whole.rows, parts.rows)


def test_the_cache_is_by_slices(data, tmp_path, monkeypatch):
    encoders, rows = EncoderSet.load(MINI), []
    monkeypatch.setattr(embedding, "ROWS", 8)
    whole = embed(data, encoders)
    real = EncoderSet.encode
    count = lambda self, m, x, *more: (rows.append(len(x)), real(self, m, x, *more))[1]
    monkeypatch.setattr(EncoderSet, "encode", count)
    first = embed(data, encoders, cache=tmp_path / "cache")
    assert np.array_equal(first.features, whole.features)
    assert len([*(tmp_path / "cache").glob("tactile-*.npy")]) > 3
    rows.clear()
    embed(data, encoders, cache=tmp_path / "cache")
    assert rows == []
    fewer = Manifest(data.table.filter(pl.col("video") != "v3"), data.root)
    again = embed(fewer, encoders, cache=tmp_path / "cache")
    assert 0 < sum(rows) < len(data) / 2
    assert np.array_equal(again.features, whole.take(fewer.ids).features)


def test_embed_says_what_it_did(data, tmp_path, palpate):
    data.save(tmp_path / "manifest.parquet")
    words = f"embed {tmp_path}/manifest.parquet --encoder {MINI} -o {tmp_path}/parts --slice 1/2"
    status, out, _ = palpate(f"{words} --json")
    assert status == 0
    assert json.loads(out)["slice"] == "1/2"
    status, out, _ = palpate(words)
    assert "samples a slice" in out
    assert "made now  no" in out


def test_what_is_embedded_must_be_files(data, tmp_path):
    with fails("must be image files"):
        embed_dataset(np.zeros((4, 8), np.float32), MINI, tmp_path / "parts")


def test_fewer_recordings_than_slices_leave_empty_parts(data, tmp_path):
    one = Manifest(data.table[:1], data.root)
    assert sorted(part.part.rows for part in made(one, tmp_path / "parts", 3)) == [0, 0, 1]
    assert read_samples(tmp_path / "parts", "parts").ids == one.ids


def test_generated_parts_are_scored_as_one_folder(tmp_path):
    pipeline, photos = make_pipeline(), write_photos(tmp_path / "photos", 7)
    draw = partial(generate, photos, model=pipeline, steps=2)
    draw(output=tmp_path / "whole")
    for k in range(3):
        draw(output=tmp_path / "parts", slice=f"{k + 1}/3")
    assert draw(output=tmp_path / "parts", slice="1/3").new == 0
    whole, parts = (read_samples(tmp_path / n, n) for n in ("whole", "parts"))
    assert sorted(whole.ids) == parts.ids
    assert parts.settings == whole.settings
    images = [dict(zip(s.ids, s.manifest.paths("tactile"), strict=True)) for s in (whole, parts)]
    for name in whole.ids:  # photos are embedded in other batches
        a, b = (np.asarray(Image.open(each[name]), int) for each in images)
        assert np.abs(a - b).max() <= 1
    with fails("with the same settings"):
        draw(output=tmp_path / "parts", slice="1/3", seed=1)
    with fails("must go with a folder"):
        draw(slice="1/3")
    shutil.rmtree(tmp_path / "parts" / "part-2-of-3")
    with fails("without 2/3", "Run: palpate generate", "--slice 2/3"):
        read_samples(tmp_path / "parts", "parts")
