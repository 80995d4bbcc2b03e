"""``palpate score``: what it refuses before it computes, in words of its own options, and what it keeps where a disk fails."""

import errno
import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from PIL import Image

from palpate.cli import scoring_runs
from palpate.core import FeatureSet, PalpateError, Score, Split
from palpate.core.digest import digest_file
from palpate.core.score import require_comparable
from palpate.evaluation import embeddings
from palpate.metrics import distance
from palpate.report.results import Results
from score_calls import call, score

VIDEOS, FRAMES, D = 8, 5, 4
IDS = [f"v{v}/{k}" for v in range(VIDEOS) for k in range(FRAMES)]
GROUPS = [f"v{v}" for v in range(VIDEOS) for _ in range(FRAMES)]
LABELS = [["Wood", "Brick"][v % 2] for v in range(VIDEOS) for _ in range(FRAMES)]
PAIR = (
    "--generated",
    "g.npz",
    "--reference",
    "r.npz",
    "--companions",
    "none",
    "--permutations",
    "0",
)


@pytest.fixture
def sets(tmp_path, monkeypatch) -> dict[str, FeatureSet]:
    """``g`` and ``r`` as .npz and .npy, and a split, in the working directory."""
    monkeypatch.chdir(tmp_path)
    found = {}
    for seed, name in enumerate("gr"):
        rng = np.random.default_rng(seed)
        x = 2 + rng.normal(size=(len(IDS), D)) + np.repeat(rng.normal(size=(VIDEOS, D)), FRAMES, 0)
        found[name] = FeatureSet(
            IDS, (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32), LABELS, GROUPS
        )
        found[name].save(Path(f"{name}.npz"))
        np.save(f"{name}.npy", found[name].features)
    Split.from_ids(train=IDS[:15], test=IDS[15:], rule={"group": "video"}, manifest="m" * 64).save(
        Path("s.json")
    )
    return found


def refused(capsys, *args) -> str:
    status, out, err = call(capsys, *args, "-q")
    assert (status, out, "Traceback" in err) == (2, "", False), err
    return err


def test_an_output_that_cannot_be_written_is_told_before_anything_is_computed(
    capsys, sets, monkeypatch
):
    monkeypatch.setattr(scoring_runs, "score", lambda *_: pytest.fail("computed"))
    Path("folder").mkdir()
    Path("file").write_text("")
    before = sorted(Path().iterdir())
    for flag in ("-o", "--latex"):
        for place in (
            "folder",
            "file/x.json",
            *(["/proc/x.json"] if Path("/proc").is_dir() else []),
        ):
            assert f"{place} must be writable" in refused(capsys, *PAIR, flag, place)
    assert sorted(Path().iterdir()) == before


def test_a_disk_that_fails_loses_no_scores(capsys, sets, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "o.json")

    monkeypatch.setattr(Results, "save", fail)
    status, out, err = call(capsys, *PAIR, "-o", "o.json", "-q")
    assert (status, "TMMD" in out, "The disk must have room for o.json" in err) == (2, True, True)


def test_no_generator_bears_the_name_of_a_control_or_of_the_reference(capsys, sets):
    with_manifest = ("m", "--split", "s.json", "--encoder", "palpate/mini")
    for name in ("real", "background only", "real, same material"):
        err = refused(capsys, *with_manifest, "--generated", "x", "--names", name)
        assert f"Got --generated x as {name!r}. Pass --names" in err
    assert "Got --generated made/real as 'real'" in refused(
        capsys, *with_manifest, "--generated", "made/real"
    )
    assert "Got --generated g.npz as 'reference'" in refused(capsys, *PAIR, "--names", "reference")
    found, _ = score(capsys, *PAIR, "--names", "real")  # no control is beside it
    assert ("TMMD", "real", "paper") in found


def test_options_that_would_do_nothing_are_refused(capsys, sets):
    Path("i.pt").write_bytes(b"")
    Path("l.csv").write_text("id,material\n")
    base, manifest = (
        PAIR[:4],
        ("m", "--split", "s.json", "--encoder", "palpate/mini", "--generated", "x"),
    )
    for args, words in (
        (
            (*base, "--companions", "ssim", "--inception", "i.pt"),
            "--inception must have a score to make",
        ),
        (
            (*base, "--companions", "ssim", "--clip", "palpate/mini"),
            "--clip must have a score to make",
        ),
        (
            (*base, "--companions", "kid", "--lpips", "i.pt", "i.pt"),
            "--lpips must have a score to make",
        ),
        ((*base, "--controls", "False"), "--controls must go with MANIFEST and --split"),
        ((*base, "--group", "contact"), "--group must have a file whose column it names"),
        ((*manifest, "--labels", "l.csv"), "--labels and --groups must go with --reference"),
        (
            (*manifest, "--normalize", "yes"),
            "--normalize must go with embeddings. Got yes with pictures",
        ),
        (
            (
                "--reference",
                "p",
                "--generated",
                "p",
                "--encoder",
                "palpate/mini",
                "--normalize",
                "no",
            ),
            "--normalize must go with embeddings",
        ),
    ):
        Path("p").mkdir(exist_ok=True)
        assert words in refused(capsys, *args)
    pl.DataFrame({"id": IDS, "contact": GROUPS}).write_csv("touches.csv")
    found, _ = score(
        capsys,
        *PAIR[:2],
        *PAIR[2:],
        "--group",
        "contact",
        "--groups",
        "touches.csv",
        "--presets",
        "grouped",
    )
    assert found["TMMD", "g", "grouped"]["value"] is not None


def test_groups_are_those_of_the_column_that_was_asked_for(capsys, sets):
    objects = [f"o{k // 10}" for k in range(len(IDS))]
    pl.DataFrame({"id": IDS, "material": LABELS, "video": GROUPS, "object": objects}).write_csv(
        "o.csv"
    )
    pl.DataFrame({"id": IDS, "material": LABELS}).write_csv("l.csv")
    for name in "gr":
        FeatureSet(IDS, sets[name].features, LABELS, objects).save(Path(f"{name}o.npz"))
    rest = ("--companions", "none", "--permutations", "0", "--presets", "grouped")
    plain = ("--generated", "g.npy", "--reference", "r.npy", *rest)
    want, _ = score(capsys, "--generated", "go.npz", "--reference", "ro.npz", "--names", "g", *rest)
    videos, data = score(capsys, *plain, "--labels", "o.csv")
    assert data["settings"]["options"]["group"] == "video"
    for args in (
        (*plain, "--labels", "o.csv"),
        (*plain, "--labels", "l.csv", "--groups", "o.csv"),
        (*PAIR[:4], *rest, "--labels", "o.csv"),
    ):
        found, data = score(capsys, *args, "--group", "object")
        assert data["settings"]["options"]["group"] == "object"
        assert (
            found["TMMD", "g", "grouped"]["value"]
            == want["TMMD", "g", "grouped"]["value"]
            != videos["TMMD", "g", "grouped"]["value"]
        )
    for args, words in (
        (
            ("--labels", "o.csv", "--group", "contact"),
            "--group contact with embeddings and o.csv, which has the columns id, material, video, object",
        ),
        (
            ("--groups", "o.csv", "--group", "contact"),
            "o.csv must have a column contact. Got columns id, material, video, object",
        ),
        (
            ("--labels", "l.csv", "--group", "video"),
            "--group video with embeddings and l.csv, which has the columns id, material",
        ),
        (("--group", "video"), "--group video with embeddings alone"),
    ):
        assert words in refused(capsys, *plain, *args)
    found, data = score(
        capsys, *PAIR, "--labels", "l.csv", "--group", "video"
    )  # which the files have
    assert found["TMMD", "g", "grouped"]["value"] == videos["TMMD", "g", "grouped"]["value"]


def test_a_bug_is_an_object_of_json_as_well(capsys, sets, monkeypatch):
    monkeypatch.setattr(scoring_runs, "score", lambda *_: 1 / 0)
    status, out, err = call(capsys, *PAIR, "--json")
    assert (status, "this is a bug in palpate" in err) == (70, True)
    assert json.loads(out) == {
        "error": "ZeroDivisionError",
        "must": "palpate must not fail of itself",
        "got": "division by zero",
        "fix": "Report the traceback on standard error",
    }


def test_a_plain_folder_beside_a_manifest_is_pointed_to_the_reference(capsys, sets):
    Path("plain").mkdir()
    err = refused(
        capsys, "m", "--split", "s.json", "--encoder", "palpate/mini", "--generated", "plain"
    )
    assert (
        "--generated must be folders of palpate generate. Got plain, which has no index of one"
        in err
    )
    assert "Score other pictures with --reference m --split s.json" in err


def test_refusals_speak_of_options_and_never_of_python(capsys, sets, monkeypatch):
    pl.DataFrame({"id": IDS, "video": ["", *GROUPS[1:]]}).write_csv("hole.csv")
    err = refused(capsys, "--generated", "g.npy", "--reference", "r.npy", "--groups", "hole.csv")
    assert (
        "groups must be known for every row. Got none in 1 row (0). Fill the empty cells of that column"
        in err
    )
    assert "None" not in err
    for sigma in ("1e-300", "1e-100", "1e100", "nan", "0"):
        assert (
            f"--sigma must be numbers from 1e-100 to 1e100, median or multi. Got '{sigma}'"
            in refused(capsys, *PAIR, "--sigma", sigma)
        )
    monkeypatch.setattr(embeddings, "STREAMED", 10)
    np.save("long.npy", 2 * sets["g"].features)
    err = refused(capsys, "--generated", "long.npy", "--reference", "r.npy")
    assert "'long' must be L2-normalized" in err
    assert "--normalize yes" not in err  # streamed rows are not copied
    assert "Divide the rows by their norm when saving them, or pass --normalize no" in err
    found, data = score(
        capsys,
        "--generated",
        "long.npy",
        "--reference",
        "r.npy",
        "--normalize",
        "no",
        "--estimator",
        "biased",
        "--sigma",
        "40",
    )
    assert (
        found["TMMD", "long", "paper, biased"]["reference"]
        == digest_file(Path("r.npy"))
        == data["settings"]["digests"]["reference"]
    )


@pytest.mark.parametrize("empty", [None, []])
def test_a_row_of_parquet_without_features_is_named(capsys, sets, empty):
    schema = {"id": pl.String, "features": pl.List(pl.Float32)}
    rows = sets["g"].features.tolist()
    for at in (0, 7):
        pl.DataFrame(
            {"id": IDS, "features": [*rows[:at], empty, *rows[at + 1 :]]}, schema=schema
        ).write_parquet("x.parquet")
        err = refused(capsys, "--generated", "x.parquet", *PAIR[2:])
        assert f"Every row of x.parquet must have features. Got none for {IDS[at]!r}" in err


def test_a_preset_with_another_estimator_says_so(capsys, sets):
    found, _ = score(capsys, *PAIR, "--estimator", "biased")
    assert {p for _, _, p in found} == {"paper, biased"}
    want = distance(sets["g"].features, sets["r"].features, estimator="biased").value
    assert found["TMMD", "g", "paper, biased"]["value"] == pytest.approx(want, abs=1e-9)
    err = refused(capsys, *PAIR, "--presets", "grouped", "--estimator", "biased")
    assert "Got the estimator biased. Drop one of the two" in err


def test_copies_are_told_whatever_the_companions_say(capsys, sets):
    copied = np.vstack([sets["r"].features[:5], sets["g"].features[5:]])
    FeatureSet(IDS, copied, LABELS, GROUPS).save(Path("copy.npz"))
    _, data = score(
        capsys, "--generated", "copy.npz", "--reference", "r.npz", "--permutations", "0"
    )
    told = [n for n in data["notes"] if n.startswith("copy: ")]
    assert told == [
        "copy: 5 of 40 generated rows are bit for bit rows of the reference: a copy is not a generator"
    ]


def test_scores_of_two_references_are_kept_apart(capsys, sets):
    sets["r"].take(IDS[:25]).save(Path("few.npz"))
    args = (*PAIR[:2], *PAIR[4:], "--companions", "kid", "--presets", "grouped")
    (one, data), (other, _) = (
        score(capsys, *args, "--reference", name) for name in ("r.npz", "few.npz")
    )
    assert data["settings"]["digests"] == {"reference": sets["r"].digest}
    assert data["settings"]["embeddings"]["g"] == {
        "file": "g.npz",
        "rows": 40,
        "digest": digest_file(Path("g.npz")),
    }
    for key, s in one.items():
        both = [Score.from_json(v) for v in (s, other[key])]
        if key[0].startswith(("TMMD", "KID")):
            assert s["reference"] == sets["r"].digest
            with pytest.raises(PalpateError, match="must agree in reference"):
                require_comparable(both)
        else:
            assert s["reference"] is None
            require_comparable(both)


def test_a_split_parts_the_generated_rows_as_well_by_id(capsys, sets):
    test = IDS[15:]
    sets["g"].take(test).save(Path("test.npz"))
    FeatureSet(IDS, sets["g"].features).save(
        Path("whole.npz")
    )  # labels and groups come from the reference
    args = (
        "--reference",
        "r.npz",
        "--split",
        "s.json",
        "--companions",
        "none",
        "--permutations",
        "0",
        "--presets",
        "grouped",
    )
    found, data = score(capsys, "--generated", "whole.npz", "test.npz", *args)
    remark = "whole: 15 of 40 touches lie outside the split's test part, and were left out"
    assert data["notes"] == [remark]
    for metric in ("TMMD", "CI-TMMD"):
        whole, part = found[metric, "whole", "grouped"], found[metric, "test", "grouped"]
        assert (whole["n"], whole["value"]) == (25, part["value"])
    sets["g"].take(IDS[:-1]).save(Path("lacks.npz"))
    assert (
        f"'lacks' must have every touch of the split's test part. Got 1 of 25 missing, first {IDS[-1]!r}"
        in refused(capsys, "--generated", "lacks.npz", *args)
    )
    own = [f"x{i}" for i in IDS]
    FeatureSet(own, sets["g"].features, LABELS, GROUPS).save(Path("own.npz"))
    found, data = score(capsys, "--generated", "own.npz", *args)
    assert (found["TMMD", "own", "grouped"]["n"], data["notes"]) == (40, [])
    FeatureSet([*IDS[:-1], "stray"], sets["g"].features).save(Path("stray.npz"))
    err = refused(capsys, "--generated", "stray.npz", *PAIR[2:])
    assert "gives labels and groups by id. Got 1 of 40 without, first 'stray'" in err


def two_files():
    """a.npy and r.npy: 12 unit rows each, here."""
    rng = np.random.default_rng(0)
    for name in ("a", "r"):
        x = rng.normal(size=(12, 4))
        np.save(f"{name}.npy", x / np.linalg.norm(x, axis=1, keepdims=True))


def test_a_file_of_groups_without_groups_and_a_cache_inside_what_is_read_are_refused(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    two_files()
    Path("g.csv").write_text("id,material\n" + "".join(f"{k},Wood\n" for k in range(12)))
    base = ("--generated", "a.npy", "--reference", "r.npy")
    Path("pics").mkdir()
    for extra, word in (
        (("--groups", "g.csv"), "must have a column video"),
        (("--cache", "c"), "--cache must go with pictures"),
        (("--cache", "g.csv"), "--cache must be a folder of its own"),
        (("--companions", "none", "fid"), "--companions must be none, or names"),
    ):
        status, _, err = call(capsys, *base, *extra)
        assert (status, word in err) == (2, True), err
    assert not Path("c").exists()
    pictures = ("--generated", "pics", "--reference", "pics", "--companions", "psnr")
    for extra, word in (
        (("--cache", "pics/c"), "a folder of its own"),
        (("--presets", "cmmd"), "--presets must go with features"),
        (("--estimator", "biased"), "--estimator must go with features"),
        (("--sigma", "3"), "--sigma must go with features"),
        (("--backend", "moments"), "--backend must go with features"),
        (("--permutations", "7"), "--permutations must go with features"),
    ):
        status, _, err = call(capsys, *pictures, *extra)
        assert (status, word in err) == (2, True), err


def test_a_preset_that_is_named_twice_is_scored_once(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    two_files()
    args = (
        "--generated",
        "a.npy",
        "--reference",
        "r.npy",
        "--presets",
        "paper",
        "paper",
        "--companions",
        "none",
        "--permutations",
        "0",
    )
    _, data = score(capsys, *args)
    assert [s["metric"] for s in data["scores"]].count("TMMD") == 1


def test_options_of_features_are_neither_taken_nor_written_down_for_pixels(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("real", "made")):
        Path(name).mkdir()
        for k, picture in enumerate(
            np.random.default_rng(seed).integers(90, 160, (3, 32, 32, 3)).astype(np.uint8), 1
        ):
            Image.fromarray(picture).save(f"{name}/{k}.png")
    base = ("--generated", "made", "--reference", "real", "--companions")
    _, data = score(capsys, *base, "psnr")
    assert data["settings"]["options"] == {"group": "video", "seed": 0}
    found, data = score(
        capsys,
        *base,
        "cmmd",
        "--clip",
        "palpate/mini",
        "--backend",
        "moments",
        "--permutations",
        "7",
    )
    assert data["settings"]["options"] == {
        "group": "video",
        "seed": 0,
        "backend": "moments",
        "permutations": 7,
    }
    cmmd = found["CMMD (CLIP)", "made", "cmmd"]["details"]
    assert (cmmd["backend"], cmmd["p_value"] is None) == ("moments", False)
    for extra, words in (
        (("cmmd", "--clip", "palpate/mini", "--sigma", "3"), "--sigma must go with features"),
        (("psnr", "--group", "contact"), "--group contact with pictures alone"),
    ):
        status, out, err = call(capsys, *base, *extra)
        assert (status, out, words in err) == (2, "", True), err
    Path("c.csv").write_text("id,material,touch\n1,m,a\n2,m,a\n3,m,b\n")
    _, data = score(capsys, *base, "psnr", "--group", "contact", "--labels", "c.csv")
    assert data["settings"]["options"]["group"] == "contact"
    status, _, err = call(capsys, *base, "psnr", "--group", "video", "--labels", "c.csv")
    assert (
        status,
        "--group video with pictures and c.csv, which has the columns id, material, touch" in err,
    ) == (2, True), err
