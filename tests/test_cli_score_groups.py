"""``palpate score``: which groups are used, that these are recorded, and that a group asked for by name is used or refused."""

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from palpate.core import FeatureSet, Split
from palpate.data.manifest import Manifest
from palpate.evaluation import embeddings
from score_calls import call, score

VIDEOS, TOUCHES, FRAMES, D = 5, 2, 3, 4
N = VIDEOS * TOUCHES * FRAMES
IDS = [f"{k:03d}" for k in range(N)]
VIDEO = [f"v{k // (TOUCHES * FRAMES)}" for k in range(N)]
TOUCH = [f"t{k // FRAMES}" for k in range(N)]
LABELS = [["Wood", "Brick"][k // 6 % 2] for k in range(N)]
REST = ("--companions", "none", "--permutations", "0")


@pytest.fixture
def files(tmp_path, monkeypatch):
    """``ours`` and ``real`` as .npy, as .npz with groups (videos), with ids alone, and columns files, in the working directory."""
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("ours", "real")):
        x = np.random.default_rng(seed).normal(size=(N, D)) + 2
        x = (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)
        np.save(f"{name}.npy", x)
        FeatureSet(IDS, x, LABELS, VIDEO).save(Path(f"{name}.npz"))
        FeatureSet(IDS, x, LABELS).save(Path(f"{name}-bare.npz"))
    pl.DataFrame({"id": IDS, "material": LABELS, "group": TOUCH}).write_csv("group.csv")
    pl.DataFrame({"id": IDS, "material": LABELS, "video": VIDEO, "contact": TOUCH}).write_csv(
        "all.csv"
    )
    test = IDS[6:]
    Split.from_ids(train=IDS[:6], test=test, rule={"group": "contact"}, manifest="m" * 64).save(
        Path("s.json")
    )


def used(capsys, *args):
    """The recorded group, and how many groups the interval of TMMD went over."""
    found, data = score(capsys, *args, *REST)
    one = next(
        s for (metric, _, preset), s in found.items() if (metric, preset) == ("TMMD", "grouped")
    )
    return data["settings"]["options"]["group"], int(
        one["interval_method"].split(" t, ")[1].split()[0]
    ) + 1


def refused(capsys, *args) -> str:
    status, out, err = call(capsys, *args, "-q")
    assert (status, out, "Traceback" in err) == (2, "", False), err
    return err


def test_the_groups_that_are_used_are_recorded(capsys, files):
    bare = ("--generated", "ours.npy", "--reference", "real.npy")
    touches = VIDEOS * TOUCHES
    assert used(capsys, *bare, "--labels", "group.csv") == ("group", touches)
    assert used(capsys, *bare, "--labels", "all.csv") == ("video", VIDEOS)
    assert used(capsys, *bare, "--labels", "all.csv", "--group", "contact") == ("contact", touches)
    assert used(capsys, *bare, "--labels", "all.csv", "--split", "s.json") == (
        "contact",
        touches - 2,
    )
    own = ("--generated", "ours.npz", "--reference", "real.npz")
    assert used(capsys, *own, "--labels", "group.csv") == (
        "video",
        VIDEOS,
    )  # what the files have themselves
    assert used(capsys, *own, "--labels", "all.csv", "--group", "contact") == ("contact", touches)


def test_groups_of_two_kinds_are_never_mixed(capsys, files):
    for pair in (("ours.npz", "real-bare.npz"), ("ours-bare.npz", "real.npz")):
        args = ("--generated", pair[0], "--reference", pair[1])
        assert used(capsys, *args, "--labels", "group.csv") == ("group", VIDEOS * TOUCHES)
    whole = ("--generated", "ours.npy", "--reference", "real.npy", "--labels", "group.csv", *REST)
    values = [
        found["TMMD", "ours", "grouped"]["value"]
        for found, _ in (
            score(capsys, *whole),
            score(capsys, "--generated", "ours.npz", "--reference", "real-bare.npz", *whole[4:]),
        )
    ]
    assert values[0] == values[1]


def test_a_group_that_was_asked_for_must_be_known_of_every_file(capsys, files):
    for made, real, bare in (
        (("ours.npz",), "real-bare.npz", "real-bare.npz"),
        (("ours-bare.npz", "ours.npy"), "real.npz", "ours.npy"),
        (("ours.npz", "ours-bare.npz"), "real-bare.npz", "real-bare.npz"),
    ):
        names = [f"{k}" for k in range(len(made))]
        err = refused(
            capsys,
            "--generated",
            *made,
            "--names",
            *names,
            "--reference",
            real,
            "--group",
            "video",
            *REST,
        )
        assert f"--group must be known of every file. Got --group video and none in {bare}" in err
    by_id = ("--generated", "ours-bare.npz", "--reference", "real.npz", "--group", "video")
    assert used(capsys, *by_id) == ("video", VIDEOS)


def test_rows_that_are_streamed_take_neither_groups_nor_permutations(capsys, files, monkeypatch):
    monkeypatch.setattr(embeddings, "STREAMED", 10)
    args = ("--generated", "ours.npy", "--reference")
    assert "none in ours.npy" in refused(capsys, *args, "real.npz", "--group", "video")
    err = refused(capsys, *args, "real.npy", "--permutations", "99")
    assert (
        "--permutations must go with rows that are held. Got 99 with so many rows without groups"
        in err
    )
    for more in ((), ("--permutations", "0"), ("--permutations", "999")):
        found, data = score(capsys, *args, "real.npy", *more)
        assert "permutations" not in data["settings"]["options"]
        assert found["TMMD", "ours", "paper"]["details"]["backend"] == "moments"


def test_a_name_that_cannot_be_written_is_refused_and_another_is_taken(capsys, files):
    odd = Path("o\udcff.npy")  # the byte 255
    try:
        odd.write_bytes(Path("ours.npy").read_bytes())
    except (OSError, UnicodeError):
        pytest.skip("file names of this system are UTF-8")
    args = ("--generated", odd, "--reference", "real.npy", *REST)
    assert r"Names of generators must be UTF-8. Got 'o\udcff'. Pass --names" in refused(
        capsys, *args
    )
    assert call(capsys, *args, "--names", "ours", "-o", "o.json", "--json")[0] == 0
    assert (
        json.loads(Path("o.json").read_text("utf-8"))["settings"]["embeddings"]["ours"]["file"]
        == "o\ufffd.npy"
    )
    Path("p\udcff").mkdir()
    err = refused(
        capsys,
        "--generated",
        "p\udcff",
        "--names",
        "p",
        "--reference",
        "p\udcff",
        "--companions",
        "psnr",
    )
    assert r"Paths of pictures must be UTF-8. Got 'p\udcff'. Rename the folder" in err


def paint(folder: str, names) -> None:
    Path(folder).mkdir(parents=True)
    for k, picture in enumerate(
        np.random.default_rng(len(folder))
        .integers(90, 160, (len(names), 32, 32, 3))
        .astype(np.uint8)
    ):
        Image.fromarray(picture).save(f"{folder}/{names[k]}.png")


def test_pictures_have_groups_of_one_kind_all_of_them(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["1", "2", "3", "4"]
    paint("real", names)
    paint("made", names)
    rows = [{"id": i, "tactile": f"{i}.png", "video": f"v{i}"} for i in names]
    for folder in ("real", "made"):
        Manifest.from_rows(rows, Path(folder)).save(Path(f"{folder}-videos/manifest.parquet"))
    pl.DataFrame({"id": names, "material": ["m"] * 4, "group": ["a", "a", "b", "b"]}).write_csv(
        "group.csv"
    )
    rest = ("--companions", "psnr")
    for made, real in (("made", "real-videos"), ("made-videos", "real")):
        err = refused(
            capsys, "--generated", made, "--reference", real, "--labels", "group.csv", *rest
        )
        own = next(name for name in (made, real) if name.endswith("videos"))
        assert (
            f"All groups must be of one kind. Got column video of {own} and column group of group.csv"
            in err
        )
    for ends, group in (("", "group"), ("-videos", "video")):
        _, data = score(
            capsys,
            "--generated",
            f"made{ends}",
            "--reference",
            f"real{ends}",
            "--labels",
            "group.csv",
            *rest,
        )
        assert data["settings"]["options"]["group"] == group
    err = refused(
        capsys, "--generated", "made-videos", "--reference", "real", "--group", "video", *rest
    )
    assert "--group must be known of every file. Got --group video and none in real." in err
    _, data = score(
        capsys, "--generated", "made", "--reference", "real-videos", "--group", "video", *rest
    )  # by id
    assert data["settings"]["options"]["group"] == "video"


def test_a_column_of_the_manifest_without_values_is_no_group(
    capsys, monkeypatch, tmp_path, small_manifest
):
    from palpate.encoders.encoder_set import EncoderSet

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(EncoderSet, "load", lambda *_, **__: None)
    ids = small_manifest.ids
    rows = [
        r | {"object": f"o{r['video']}" if r["id"] in ids[16:] else None}
        for r in small_manifest.table.iter_rows(named=True)
    ]
    Manifest.from_rows(rows, small_manifest.root).save(Path("m/manifest.parquet"))
    for name, (train, test) in {
        "test": (ids[16:], ids[:16]),
        "train": (ids[:16], ids[16:]),
    }.items():
        Split.from_ids(
            train=train,
            test=test,
            rule={"group": "video"},
            manifest=Manifest.load(Path("m")).digest,
        ).save(Path(f"{name}.json"))
    paint("g/images", [i.replace("/", "-") for i in ids])
    index = {
        "format": "palpate-generated/1",
        "complete": True,
        "settings": {},
        "digest": "",
        "notice": "",
        "skipped": [],
    }
    Path("g/index.json").write_text(
        json.dumps(index | {"images": {i: f"{i.replace('/', '-')}.png" for i in ids}})
    )
    for part in ("test", "train"):
        args = (
            "m",
            "--split",
            f"{part}.json",
            "--encoder",
            "palpate/mini",
            "--generated",
            "g",
            "--group",
            "object",
            "--presets",
            "paper",
        )
        err = refused(capsys, *args)
        assert (
            f"--group must name a column with values. Got --group object and no value in the {part} part of m. Leave it out, or fill"
            in err
        )
