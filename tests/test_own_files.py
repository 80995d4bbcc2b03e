"""What a stopped run left is checked before it is believed: damaged, it is made again or refused.

Every file that a stopped run of a verb left is damaged in turn, and the command is run again. It
ends with what an undisturbed run gives, or with status 2; never with something else.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from forge.commands import call
from forge.damage import DAMAGES, cut, flip, inflate
from forge.pictures import picture, write_video
from forge.servers import FakeServer
from palpate.cli import terminal
from palpate.core import (
    PalpateError,
    cached,
    digest_file,
    digest_folder,
    digest_json,
    digest_lines,
    files,
    is_whole,
    read_json,
    sealed,
    sealed_path,
    write_json,
)
from palpate.data.manifest import Manifest

pytest.importorskip("torch")


@dataclass(frozen=True)
class Verb:
    """A verb that resumes.

    Attributes:
        words: the command.
        stop: task and count of its progress at which it is stopped; None: it ends.
        result: a digest of what it gives, of its folder and of what it printed.
        sampled: one file of each kind is damaged, in two ways; else each in all.
    """

    words: tuple[str, ...]
    stop: tuple[str, int] | None
    result: Callable[[Path, str], str]
    sampled: bool = False

    def damaged(self, left):
        """Files of a folder, by their names in it, and how each is damaged."""
        names = [p.relative_to(left) for p in sorted(left.rglob("*")) if p.is_file()]
        if not self.sampled:
            return [*product(names, DAMAGES)]
        kinds = {p.suffix: p for p in names}
        return [*product(kinds.values(), (flip, cut))]


def weights(folder, out):
    """Of the published weights."""
    files = sorted((folder / "out").rglob("*.safetensors"))
    return digest_lines(f"{p.relative_to(folder)} {digest_file(p)}" for p in files)


def everything(folder, out):
    return digest_folder(folder / "out")


def imported(folder, out):
    """Of the manifest and its images."""
    images = sorted((folder / "out").rglob("*.jpg"))
    return digest_lines([Manifest.load(folder / "out").digest, *map(digest_file, images)])


def captions(folder, out):
    return digest_file(folder / "out" / "captions.parquet")


def scores(folder, out):
    return digest_lines(
        f"{score['metric']} {score['value']}" for score in json.loads(out)["scores"]
    )


def audited(folder, out):
    return digest_json(json.loads(out))


def studied(folder, out):
    """Of what a study says, of its models and of its scores."""
    results = json.loads((folder / "out" / "results.json").read_text())
    said = {k: v for k, v in json.loads(out).items() if k in ("facts", "digests")}
    return digest_json([said, [s["value"] for s in results["scores"]]])


TRAIN = ("../tag", "--split", "../split.json", "--preset", "tiny", "-o", "out", "--seed", "3")
AUDIT = ("audit", "../tag", "--split", "../split.json", "--cache", "cache", "--json")
MINI = ("--clip", "palpate/mini")
WORLD = ("world", "-o", "out", "--preset", "tiny", "--materials", "2", "--workers", "1")
WORLD += ("--objects-per-material", "1", "--size", "16", "--layout")
VERBS = {
    "import": Verb(
        ("import", "../videos", "-o", "out", "--every", "4"), ("extracting frames", 1), imported
    ),
    "world": Verb((*WORLD, "videos"), ("rendering videos", 1), everything),
    "world of frames": Verb((*WORLD, "frames"), ("rendering videos", 1), everything),
    "generate": Verb(
        ("generate", "../photos", "-o", "out", "--steps", "1", "--batch", "2"),
        ("generating", 2),
        everything,
    ),
    "embed": Verb(
        ("embed", "../tag", "--encoder", "palpate/handcrafted", "-o", "out"), None, everything
    ),
    "caption": Verb(("caption", "../tag", "-o", "out"), ("describing", 8), captions),
    "score": Verb(
        (
            *("score", "--generated", "../photos", "--reference", "../tag", "--json"),
            *("--encoder", "palpate/mini", "--cache", "cache"),
            *("--companions", "none", "--permutations", "0"),
        ),
        None,
        scores,
    ),
    "audit": Verb(AUDIT, None, audited, sampled=True),
    "audit --impact": Verb(
        (*AUDIT, "--impact", "--encoder", "palpate/mini", "--allow-seen"),
        None,
        audited,
        sampled=True,
    ),
    "probe": Verb(
        (
            *("probe", "../tag", "--split", "../split.json", "--train", "--preset", "tiny"),
            *("--seeds", "0", "1", "--epochs", "2", "--work", "out", "--json"),
        ),
        ("split-1: training the tactile encoder", 3),
        scores,
        sampled=True,
    ),
    "demo": Verb(
        ("demo", "--preset", "tiny", "-o", "out", "--json"),
        ("generator: generator", 2),
        studied,
        sampled=True,
    ),
    "demo of images": Verb(
        ("demo", "--preset", "tiny", "-o", "out", "--json"),
        ("generated: generating", 8),
        studied,
        sampled=True,
    ),
    "train autoencoder": Verb(
        ("train", "autoencoder", *TRAIN, "--set", "autoencoder.steps_free=4"),
        ("autoencoder", 2),
        weights,
    ),
    "train encoder": Verb(
        ("train", "encoder", *TRAIN, "--epochs", "2"), ("training the tactile encoder", 3), weights
    ),
    "train generator": Verb(
        ("train", "generator", *TRAIN, *MINI, "--steps", "4"), ("generator", 2), weights
    ),
}


#: The others take longer: trainings, a file for each frame, or an audit a file.
DAILY = ("import", "world", "generate", "caption")


class Stopper:
    """In place of the log of progress: presses Ctrl-C at a task and count."""

    stop = None

    def __init__(self, print_line):
        self.print_line = print_line

    def __call__(self, task, done, total, remark=""):
        if not total:
            self.print_line(task)
        if (task, done) == type(self).stop:
            raise KeyboardInterrupt


@pytest.fixture
def place(tag, tmp_path, monkeypatch):
    """Data and photos, and a folder beside them where commands run."""
    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(picture(k + 1, 32)).save(tmp_path / "photos" / f"{k}.png")
    for side in ("vision", "tactile"):
        write_video(tmp_path / "videos" / "a" / f"{side}.mp4", 12)
    monkeypatch.setattr(terminal, "_LogProgress", Stopper)
    monkeypatch.setattr(Stopper, "stop", None)
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n in DAILY else pytest.mark.nightly) for n in VERBS],
)
def test_each_damaged_file_of_a_stopped_run_is_made_again_or_refused(
    place, capsys, monkeypatch, name
):
    verb = VERBS[name]
    with FakeServer() as server:
        words = [*verb.words, *["--server", server.url] * (name == "caption")]
        status, out, err = call(capsys, *words)
        assert status == 0, err
        whole = verb.result(place, out)
        if verb.stop:
            empty(place)
            monkeypatch.setattr(Stopper, "stop", verb.stop)
            assert call(capsys, *words)[0] == 130
            monkeypatch.setattr(Stopper, "stop", None)
        left = place.with_name("left")
        shutil.copytree(place, left)
        cases, said = verb.damaged(left), 0
        assert cases
        for file, damage in cases:
            empty(place)
            shutil.copytree(left, place, dirs_exist_ok=True)
            damage(place / file)
            status, out, err = call(capsys, *words)
            case = f"{file}, {damage.__name__}: {status}\n{err}"
            assert status in (0, 2), case
            if status == 0:
                assert verb.result(place, out) == whole, case
                said += "is damaged: making it again" in err
            else:
                assert "Traceback" not in err, case
                assert any(w in err for w in ("damaged", "must be JSON", "another line")), case
    assert said or name in ("import", "embed", "generate", "caption")


def empty(folder):
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()


@pytest.mark.parametrize(
    ("name", "damage"), [*product(("a.npy", "a.npy.sha256"), DAMAGES), ("a.npy.sha256", inflate)]
)
def test_a_damaged_cache_is_made_again_and_says_so(tmp_path, monkeypatch, name, damage):
    monkeypatch.setattr("palpate.core.caches.BLOCK", 64)  # of several blocks
    made, said, array = [], [], np.arange(100.0)

    def make(part):
        made.append(part)
        np.save(part, array)

    def load():
        progress = lambda *words: said.append(words[0])
        return cached(tmp_path / "a.npy", make, np.load, progress)

    for _ in range(2):
        assert np.array_equal(load(), array)
    assert (len(made), said) == (1, [])
    damage(tmp_path / name)
    assert np.array_equal(load(), array)
    assert (len(made), said) == (2, [f"{tmp_path / 'a.npy'} is damaged: making it again"])
    assert np.array_equal(load(), array)
    assert len(made) == 2


def test_a_kill_between_digest_and_file_leaves_the_file_before_whole(tmp_path, monkeypatch):
    file, real = tmp_path / "a", files._move

    def write(text):
        with sealed_path(file) as part:
            part.write_text(text)

    def killed(part, final, flush):
        if final == file:
            raise KeyboardInterrupt
        real(part, final, flush)

    write("one")
    for _ in range(3):
        with monkeypatch.context() as patch:
            patch.setattr(files, "_move", killed)
            with pytest.raises(KeyboardInterrupt):
                write("two")
        assert file.read_text() == "one"
        assert is_whole(file)
    write("two")
    assert is_whole(file)
    flip(file)
    assert not is_whole(file)


def test_a_flush_comes_before_the_renaming(tmp_path, monkeypatch):
    events, flush, replace = [], files._flush, Path.replace
    monkeypatch.setattr(
        files, "_flush", lambda path: (events.append(("flush", path.name)), flush(path))
    )
    monkeypatch.setattr(
        Path, "replace", lambda a, b: (events.append(("rename", b.name)), replace(a, b))[1]
    )
    with sealed_path(tmp_path / "a") as part:
        part.write_text("x")
    folder = tmp_path.name
    assert [e for e in events if e[0] == "rename"] == [("rename", "a.sha256"), ("rename", "a")]
    assert events[3:] == [("flush", part.name), ("rename", "a"), ("flush", folder)]


@pytest.mark.parametrize("damage", DAMAGES)
def test_an_object_in_json_holds_its_digest(tmp_path, damage):
    record = {"b": [1, 0.1, None, "é"], "a": {"z": (1, 2), "y": True}, "n": 1e-300}
    write_json(tmp_path / "r.json", sealed(record))
    plain = read_json(tmp_path / "r.json", "record")
    assert [*plain] == ["b", "a", "n"]
    assert plain == json.loads(json.dumps(record))
    damage(tmp_path / "r.json")
    with pytest.raises(PalpateError, match="record"):
        read_json(tmp_path / "r.json", "record")
    with pytest.raises(ValueError, match="not JSON compliant"):
        sealed({"a": float("nan")})
