"""``palpate score`` without a split: embeddings, several generators, and every way to ask for what cannot be compared."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from palpate.cli import main
from palpate.core import FeatureSet, PalpateError, Split
from palpate.evaluation import embeddings, streamed
from palpate.metrics import Polynomial, compare, distance, i_tmmd
from palpate.metrics.paired import mean_differences
from palpate.report.results import Results
from score_calls import call, score

VIDEOS, FRAMES, D = 8, 6, 5
IDS = [f"v{v}/{k}" for v in range(VIDEOS) for k in range(FRAMES)]
GROUPS = [f"v{v}" for v in range(VIDEOS) for _ in range(FRAMES)]
LABELS = [["Wood", "Brick"][v % 2] for v in range(VIDEOS) for _ in range(FRAMES)]


def unit(x):
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def features(seed: int, noise: float, shift: float) -> np.ndarray:
    rng = np.random.default_rng(0)  # the samples
    real = (
        3
        + np.repeat(rng.normal(size=(VIDEOS, D)), FRAMES, 0)
        + rng.normal(size=(len(IDS), D)) * 0.3
    )
    own = np.random.default_rng(seed)
    return unit(real + own.normal(size=real.shape) * noise + shift * own.normal(size=D))


@pytest.fixture
def sets(tmp_path, monkeypatch) -> dict[str, FeatureSet]:
    """``real``, ``near`` and ``far`` as .npz and .npy in the working directory."""
    monkeypatch.chdir(tmp_path)
    made = {
        "real": features(1, 0.1, 0),
        "near": features(2, 0.2, 0.1),
        "far": features(3, 0.5, 1.5),
    }
    found = {name: FeatureSet(IDS, x, LABELS, GROUPS, "e" * 64) for name, x in made.items()}
    for name, one in found.items():
        one.save(Path(f"{name}.npz"))
        np.save(f"{name}.npy", one.features)
    return found


def brute(x, y, kernel, groups=None):
    """MMD^2 by two loops; pairs of one group left out."""

    def mean(a, b, ga, gb, same):
        found = [
            kernel(a[i], b[j])
            for i in range(len(a))
            for j in range(len(b))
            if not (same and i == j) and (groups is None or ga[i] != gb[j])
        ]
        return sum(found) / len(found)

    g = groups or [""] * len(x)
    return mean(x, x, g, g, True) + mean(y, y, g, g, True) - 2 * mean(x, y, g, g, False)


def test_embeddings_side_by_side_agree_with_loops_and_with_the_library(capsys, sets):
    found, data = score(capsys, "--generated", "near.npz", "far.npz", "--reference", "real.npz")
    x, y = sets["far"].features.astype(float), sets["real"].features.astype(float)
    gauss = lambda a, b: 1000 * float(np.exp(-((a - b) ** 2).sum() / 200))  # noqa: E731
    poly = lambda a, b: 1000 * float((a @ b / D + 1) ** 3)  # noqa: E731
    assert found["TMMD", "far", "paper"]["value"] == pytest.approx(brute(x, y, gauss), abs=1e-6)
    assert found["TMMD", "far", "grouped"]["value"] == pytest.approx(
        brute(x, y, gauss, GROUPS), abs=1e-6
    )
    assert found["KID (embeddings)", "far", None]["value"] == pytest.approx(
        brute(x, y, poly), rel=1e-9
    )
    wanted = compare(
        {n: sets[n] for n in ("near", "far")}, sets["real"], floor=sets["real"], preset="grouped"
    )
    for s in [*wanted.scores, *wanted.differences]:
        got = found[s.metric, s.subject, "grouped"]
        assert (got["value"], tuple(got["interval"] or ())) == (s.value, s.interval or ()), s.metric
        assert got["floor"] == s.floor
    ahead = found["TMMD difference", "near - far", "grouped"]
    assert ahead["details"]["better"] == "near"
    assert ahead["details"]["p_better"] > 0.99
    assert ahead["note"].startswith("near is better with")
    metrics = {m for m, _, _ in found}
    assert {
        f"{m} (embeddings)" for m in ("FID", "KID", "Precision", "Recall", "Density", "Coverage")
    } <= metrics
    assert data["settings"]["digests"] == {"encoder": "e" * 64, "reference": sets["real"].digest}
    assert data["commands"][0].startswith("palpate score --generated near.npz")


def test_the_terminal_has_both_tables(capsys, sets):
    status, out, _ = call(
        capsys,
        "--generated",
        "near.npz",
        "far.npz",
        "--reference",
        "real.npz",
        "--names",
        "ours [x]",
        "them",
    )
    assert status == 0
    head, tail = out.split("Differences on the same samples, a - b")
    assert "ours [x]" in head
    assert "floor" in head
    assert "confidence that a is better" in tail
    row = next(
        line for line in tail.splitlines() if line.startswith("TMMD ↓") and "grouped" in line
    )
    assert "> 99.9 %" in row
    assert "Holm p" in tail


def test_embeddings_load_no_torch_and_the_results_make_a_page(sets):
    code = (
        "import sys; from palpate.cli import main\n"
        "assert main(['score', '--generated', 'near.npz', 'far.npz', '--reference', 'real.npz', '-o', 's.json', '--latex', 't.tex', '-q']) == 0\n"
        "assert not {'torch', 'transformers', 'diffusers', 'safetensors'} & set(sys.modules), sorted(sys.modules)\n"
        "assert main(['report', 's.json', '-o', 'page.html', '-q']) == 0"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Paired differences" in Path("page.html").read_text()
    results = Results.load(Path("s.json"))
    assert {s.subject for s in results.scores} == {"near", "far", "near - far"}
    assert Path("t.tex").read_text().startswith("% palpate")
    for path in ("s.json", "t.tex"):  # what the command wrote it may replace, nothing else
        Path(path).write_text("mine")
    for flag, path in (("-o", "s.json"), ("--latex", "t.tex"), ("-o", "near.npz")):
        assert (
            main(["score", "--generated", "near.npz", "--reference", "real.npz", flag, path]) == 2
        )
    assert Path("t.tex").read_text() == "mine"


def test_bare_arrays_have_no_groups_and_pair_by_row_alone(capsys, sets):
    found, data = score(
        capsys,
        "--generated",
        "near.npy",
        "far.npy",
        "--reference",
        "real.npy",
        "--companions",
        "none",
    )
    assert {p for _, _, p in found} == {"paper"}
    assert found["TMMD", "near", "paper"]["value"] == pytest.approx(
        distance(sets["near"].features, sets["real"].features).value, abs=1e-9
    )
    assert found["CI-TMMD", "near", "paper"]["value"] is None
    assert found["TMMD difference", "near - far", "paper"]["interval"] is not None
    assert any("Row k of every generator" in note for note in data["notes"])
    np.save("short.npy", sets["far"].features[:30])
    found, data = score(
        capsys,
        "--generated",
        "near.npy",
        "short.npy",
        "--reference",
        "real.npy",
        "--companions",
        "cmmd",
    )
    assert not [m for m, _, _ in found if "difference" in m]
    assert found["CMMD (embeddings)", "short", "cmmd"]["n"] == 30
    assert any("No differences" in note for note in data["notes"])


def test_copies_of_real_touches_are_told(capsys, sets):
    np.savez(
        "copy.npz",
        features=np.vstack([sets["real"].features[:5], sets["far"].features[5:]]),
        ids=np.array(IDS),
    )
    status, out, _ = call(
        capsys, "--generated", "copy.npz", "--reference", "real.npz", "--companions", "none", "-q"
    )
    assert status == 0
    assert (
        "copy: 5 of 48 generated rows are bit for bit rows of the reference: a copy is not a generator"
        in out
    )


def test_a_file_of_labels_and_groups_makes_bare_arrays_whole(capsys, sets):
    rows = pl.DataFrame({"id": IDS, "material": LABELS, "video": GROUPS})
    rows.write_csv("both.csv")
    rows.select("id", "material").write_csv("labels.csv")
    rows.select("id", pl.col("video").alias("group")).write_parquet("groups.parquet")
    wanted, _ = score(
        capsys, "--generated", "far.npz", "--reference", "real.npz", "--companions", "none"
    )
    for given in (
        ("--labels", "both.csv"),
        ("--labels", "labels.csv", "--groups", "groups.parquet"),
    ):
        found, _ = score(
            capsys,
            "--generated",
            "far.npy",
            "--reference",
            "real.npy",
            "--companions",
            "none",
            *given,
        )
        assert {k: s["value"] for k, s in found.items()} == {
            k: s["value"] for k, s in wanted.items()
        }
    found, _ = score(
        capsys,
        "--generated",
        "far.npy",
        "--reference",
        "real.npy",
        "--companions",
        "none",
        "--groups",
        "groups.parquet",
    )
    assert found["I-TMMD", "far", "grouped"]["value"] == pytest.approx(
        wanted["I-TMMD", "far", "grouped"]["value"], abs=1e-9
    )
    assert found["CI-TMMD", "far", "grouped"]["value"] is None


def test_a_generator_takes_labels_and_groups_from_the_reference_by_id(capsys, sets):
    order = np.random.default_rng(0).permutation(len(IDS))
    np.savez("bare.npz", features=sets["far"].features[order], ids=np.array(IDS)[order])
    wanted, _ = score(
        capsys,
        "--generated",
        "far.npz",
        "--reference",
        "real.npz",
        "--companions",
        "none",
        "--presets",
        "grouped",
    )
    found, _ = score(
        capsys,
        "--generated",
        "bare.npz",
        "--reference",
        "real.npz",
        "--companions",
        "none",
        "--presets",
        "grouped",
    )
    for (metric, _, preset), s in wanted.items():
        assert found[metric, "bare", preset]["value"] == pytest.approx(s["value"], abs=1e-9), metric


def test_several_bandwidths_have_names_of_their_own(capsys, sets):
    found, _ = score(
        capsys,
        "--generated",
        "near.npz",
        "far.npz",
        "--reference",
        "real.npz",
        "--sigma",
        "10",
        "1",
        "median",
        "multi",
        "--companions",
        "cmmd",
    )
    far, real = sets["far"].features, sets["real"].features
    assert found["TMMD (σ = 1)", "far", "paper"]["value"] == pytest.approx(
        distance(far, real, sigma=1).value, abs=1e-9
    )
    assert found["TMMD (σ median)", "far", "paper"]["settings"]["kernel"] == "gaussian, median"
    assert ("D-TMMD (σ multi) difference", "near - far", "grouped") in found
    assert found["CMMD (embeddings)", "far", "cmmd"]["value"] == pytest.approx(
        distance(far, real, estimator="biased").value, abs=1e-9
    )
    assert ("CMMD (embeddings) difference", "near - far", "cmmd") in found
    only, _ = score(
        capsys,
        "--generated",
        "far.npz",
        "--reference",
        "real.npz",
        "--sigma",
        "1",
        "--companions",
        "none",
    )
    assert only["TMMD", "far", "paper"]["bandwidth"] == 1


def test_a_split_restricts_the_reference_and_gives_the_floor(capsys, sets):
    test, train = IDS[:24], IDS[24:]
    split = Split.from_ids(train=train, test=test, rule={"name": "halves"}, manifest="m" * 64)
    split.save(Path("split.json"))
    sets["far"].take(test).save(Path("made.npz"))
    found, _ = score(
        capsys,
        "--generated",
        "made.npz",
        "--reference",
        "real.npz",
        "--split",
        "split.json",
        "--companions",
        "none",
    )
    s, real = found["TMMD", "made", "paper"], sets["real"]
    assert (s["n"], s["m"], s["split"]) == (24, 24, split.digest)
    assert s["floor"] == pytest.approx(
        distance(real.take(train).features, real.take(test).features).value, abs=1e-9
    )


def test_many_bare_rows_are_streamed_and_never_held(capsys, sets, monkeypatch):
    rng = np.random.default_rng(5)
    for name, shift in (("big", 0.1), ("base", 0.0)):
        np.save(f"{name}.npy", unit(rng.normal(size=(600, 16)) + 2 + shift))
    wanted = distance(np.load("big.npy"), np.load("base.npy"), backend="blocked").value
    monkeypatch.setattr(embeddings, "STREAMED", 500)
    seen = []
    monkeypatch.setattr(
        streamed, "distance", lambda x, y, **how: seen.append((x, y)) or distance(x, y, **how)
    )
    monkeypatch.setattr(
        embeddings.Embeddings, "feature_set", lambda *_: pytest.fail("held in memory")
    )
    found, data = score(capsys, "--generated", "big.npy", "--reference", "base.npy")
    assert all(isinstance(v, np.memmap) for v in seen[0])
    s = found["TMMD", "big", "paper"]
    assert len(found) == 1
    assert s["details"]["backend"] == "moments"
    assert abs(s["value"] - wanted) <= s["details"]["bound"] + 1e-6
    assert 0 < s["details"]["bound"] < 1e-4
    assert data["notes"][0].startswith("Streamed")
    for extra, word in (
        (("--presets", "grouped"), "--groups"),
        (("--sigma", "multi"), "--sigma median"),
        (("--normalize", "yes"), "when saving"),
        (("--companions", "fid"), "TMMD alone"),
    ):
        status, _, err = call(capsys, "--generated", "big.npy", "--reference", "base.npy", *extra)
        assert (status, word in err) == (2, True), err


def test_polynomial_is_kids(sets):
    """The companion's kernel is (x.y / d + 1)^3: the settings say so."""
    assert Polynomial().settings() == {
        "kernel": "polynomial",
        "degree": 3,
        "gamma": "1/d",
        "coef0": 1.0,
    }


def bad_files(sets):
    nan = sets["far"].features.copy()
    nan[7] = np.nan
    np.savez("nan.npz", features=nan, ids=np.array(IDS))
    np.save("long.npy", 2 * sets["far"].features)
    np.save("wide.npy", np.hstack([sets["far"].features] * 2))
    FeatureSet(IDS, sets["far"].features, LABELS, GROUPS, "f" * 64).save(Path("other.npz"))
    FeatureSet([*IDS[:-1], "x"], sets["far"].features, LABELS, GROUPS, "e" * 64).save(
        Path("ids.npz")
    )
    np.save("none.npy", np.zeros((0, D), np.float32))
    Path("words.txt").write_text("a")
    Path("empty").mkdir()
    Path("hidden").mkdir()
    Path("hidden/.x.png").write_bytes(b"")


R = ("--reference", "real.npz")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ((*R, "--generated", "nan.npz"), ("nan.npz", "v1/1", "NaN")),
        ((*R, "--generated", "long.npy"), ("L2-normalized", "--normalize yes")),
        ((*R, "--generated", "wide.npy"), ("one width", "10 and 5")),
        ((*R, "--generated", "other.npz"), ("one encoder", "ffffffffffff")),
        ((*R, "--generated", "far.npz", "ids.npz"), ("same samples", "1 missing and 1 surplus")),
        (("--reference", "none.npy", "--generated", "far.npy"), ("none.npy",)),
        ((*R, "--generated", "words.txt"), ("words.txt", ".safetensors", "pickles")),
        ((*R, "--generated", "nowhere"), ("nothing at nowhere",)),
        ((*R, "--generated", "far.npz", "./far.npz"), ("differ in name", "--names")),
        ((*R, "--generated", "far.npz", "--names", "a", "b"), ("--names", "2 names for 1")),
        ((*R, "--generated", "far.npz", "--sigma", "ten"), ("--sigma", "'ten'")),
        ((*R, "--generated", "far.npz", "--sigma", "-1"), ("--sigma",)),
        ((*R, "--generated", "far.npz", "--companions", "ssim"), ("ssim must have pictures",)),
        (
            (*R, "--generated", "far.npz", "--encoder", "palpate/mini"),
            ("--encoder must go with pictures",),
        ),
        ((*R, "--generated", "far.npz", "--permutations", "-1"), ("--permutations",)),
        (
            ("--reference", "real.npy", "--generated", "far.npy", "--presets", "grouped"),
            ("--groups FILE, or --presets paper",),
        ),
        (("--generated", "far.npz"), ("given once", "neither")),
        (("m.parquet", *R, "--generated", "far.npz"), ("given once", "both")),
        (("m.parquet", "--generated", "far.npz"), ("no --split and --encoder",)),
        ((*R, "--generated", "far.npz", "--labels", "words.txt"), ("words.txt",)),
        ((*R, "--generated", "empty", "--encoder", "palpate/mini"), ("both be pictures",)),
        (
            ("--reference", "empty", "--generated", "empty", "--encoder", "palpate/mini"),
            ("images in empty", "none"),
        ),
        (
            ("--reference", "hidden", "--generated", "hidden", "--companions", "ssim"),
            ("images in hidden",),
        ),
        (
            ("--reference", "empty", "--generated", "empty"),
            ("--encoder palpate/mini", "--companions ssim"),
        ),
    ],
)
def test_mistakes_are_one_line_with_status_2(capsys, sets, args, words):
    bad_files(sets)
    status, out, err = call(capsys, *args)
    lines = [line for line in err.splitlines() if line.startswith("palpate ")]
    assert (status, len(lines), out) == (2, 1, ""), err
    assert "Traceback" not in err
    for word in words:
        assert word in lines[0], lines[0]


def test_differences_need_comparable_scores():
    from palpate.core import Score

    x, y = (
        Score("SSIM", "a", 0.5, settings={"size": 32}),
        Score("SSIM", "b", 0.6, settings={"size": 64}),
    )
    with pytest.raises(PalpateError, match="must agree in settings"):
        mean_differences({"a": x, "b": y}, {"a": np.ones(3), "b": np.zeros(3)}, None)


@pytest.mark.parametrize(("up", "better"), [(True, "a"), (False, "b")])
def test_the_better_mean_is_the_one_in_the_metrics_direction(up, better):
    from palpate.core import Score

    rng = np.random.default_rng(0)
    low, groups = rng.normal(size=40), [f"v{k % 8}" for k in range(40)]
    values = {"a": low + 1 + 0.1 * rng.normal(size=40), "b": low}
    scores = {
        name: Score("X", name, float(v.mean()), higher_is_better=up) for name, v in values.items()
    }
    one = mean_differences(scores, values, groups)[0].details
    assert (one["better"], one["decided"]) == (better, True)
    assert (one["p_better"] > 0.99) == (better == "a")
    assert (one["p_better"] < 0.01) == (better == "b")


def test_what_needs_no_reference_is_shown_as_its_excess_beside_a_comparable_floor(capsys, sets):
    found, data = score(
        capsys,
        "--generated",
        "near.npz",
        "far.npz",
        "--reference",
        "real.npz",
        "--companions",
        "none",
        "--presets",
        "grouped",
    )
    excess, whole = found["I-TMMD E", "near", "grouped"], found["I-TMMD", "near", "grouped"]
    assert (excess["value"], excess["interval"]) == (
        whole["details"]["E"],
        whole["details"]["E_interval"],
    )
    assert excess["floor"] == pytest.approx(i_tmmd(sets["real"]).details["E"], abs=1e-9)
    assert whole["floor"] == pytest.approx(i_tmmd(sets["real"]).value, abs=1e-9)
    assert excess["higher_is_better"] is None
    assert ("CI-TMMD E", "far", "grouped") in found
    few = sets["real"].take(
        [i for i, g in zip(IDS, GROUPS, strict=True) if g in sorted(set(GROUPS))[::2]]
    )
    few.save(Path("few.npz"))
    found, data = score(
        capsys,
        "--generated",
        "near.npz",
        "far.npz",
        "--reference",
        "few.npz",
        "--companions",
        "none",
        "--presets",
        "grouped",
    )
    assert (
        found["I-TMMD", "near", "grouped"]["floor"] is None
    )  # another number of videos: not comparable
    assert found["I-TMMD E", "near", "grouped"]["floor"] == pytest.approx(
        i_tmmd(few).details["E"], abs=1e-9
    )
    verdicts = {
        d["metric"]: d["details"]["better"]
        for d in data["scores"]
        if d["metric"].endswith("difference")
    }
    assert verdicts["I-TMMD difference"] is None
    assert verdicts["TMMD difference"] == "near"


def test_generators_that_vary_less_than_real_touches_are_told(capsys, sets):
    still = dataclasses.replace(
        sets["real"],
        features=unit(sets["real"].features.mean(axis=0) + 0.05 * sets["real"].features),
    )
    still.save(Path("still.npz"))
    _, data = score(
        capsys,
        "--generated",
        "still.npz",
        "--reference",
        "real.npz",
        "--companions",
        "none",
        "--presets",
        "grouped",
    )
    assert any("I-TMMD E, still: below the floor" in note for note in data["notes"])
    wild = dataclasses.replace(sets["real"], features=features(9, 0.1, 0) + 0)
    x = wild.features + np.repeat(
        np.random.default_rng(1).normal(size=(VIDEOS, D)), FRAMES, 0
    ).astype(np.float32)
    dataclasses.replace(wild, features=unit(x)).save(Path("wild.npz"))
    _, data = score(
        capsys,
        "--generated",
        "wild.npz",
        "--reference",
        "real.npz",
        "--companions",
        "none",
        "--presets",
        "grouped",
    )
    assert not any("below the floor" in note for note in data["notes"])


def test_companions_on_features_have_paired_differences(capsys, sets):
    found, data = score(
        capsys,
        "--generated",
        "near.npz",
        "far.npz",
        "--reference",
        "real.npz",
        "--companions",
        "kid",
        "prdc",
        "--presets",
        "grouped",
    )
    differences = {d["metric"]: d for d in data["scores"] if d["metric"].endswith("difference")}
    kid = next(d for m, d in differences.items() if m.startswith("KID"))
    assert kid["details"]["better"] == "near"
    assert kid["interval"][1] < 0
    one = next(
        s for (m, subject, _), s in found.items() if m.startswith("KID") and subject == "near"
    )
    direct = distance(
        sets["near"].features, sets["real"].features, kernel=Polynomial(), normalize=False
    ).value
    assert one["value"] == pytest.approx(direct, abs=1e-9)
    assert one["interval"][0] < one["value"] < one["interval"][1]
    for name in ("Precision", "Recall", "Density", "Coverage"):
        metric = next(m for m in differences if m.startswith(name))
        a, b = (
            next(
                s["value"]
                for (m, subject, _), s in found.items()
                if m == metric.removesuffix(" difference") and subject == who
            )
            for who in ("near", "far")
        )
        assert differences[metric]["value"] == pytest.approx(a - b, abs=1e-12)


def test_streamed_rows_at_a_narrow_bandwidth_and_one_file_for_two_are_refused(
    capsys, sets, monkeypatch
):
    monkeypatch.setattr(embeddings, "STREAMED", 10)
    status, out, err = call(
        capsys, "--generated", "near.npy", "--reference", "real.npy", "--sigma", "0.3"
    )
    assert (status, out, "--backend blocked" in err) == (2, "", True)
    status, _, err = call(
        capsys,
        "--generated",
        "near.npz",
        "--reference",
        "real.npz",
        "-o",
        "same.x",
        "--latex",
        "same.x",
    )
    assert (status, "two files" in err, Path("same.x").exists()) == (2, True, False)


def test_what_was_widened_or_formed_is_in_the_results_and_said_once(capsys, sets):
    far = np.load("far.npz")
    np.savez(
        "thin.npz",
        features=far["features"].astype(np.float16),
        **{k: far[k] for k in ("ids", "labels", "groups")},
    )
    status, out, err = call(
        capsys, "--generated", "thin.npz", "--reference", "real.npz", "-o", "s.json"
    )
    note = (
        "The features in thin.npz: float16 features were widened to float32; their rounding stays"
    )
    assert status == 0, err
    assert [n for n in Results.load(Path("s.json")).notes if "float16" in n] == [
        note
    ]  # the companions say no more
    assert (note in err, note in out) == (True, False)
    status, out, _ = call(
        capsys, "--generated", "thin.npz", "--reference", "real.npz", "--companions", "none", "-q"
    )
    assert (status, note in out) == (0, True)


def test_errors_name_the_generator_that_is_wrong(capsys, sets):
    spoilt = sets["far"].features.copy()
    spoilt[3] *= 2
    np.savez(
        "spoilt.npz",
        features=spoilt,
        ids=np.array(IDS),
        groups=np.array(GROUPS),
        labels=np.array(LABELS),
    )
    status, _, err = call(
        capsys, "--generated", "near.npz", "spoilt.npz", "--reference", "real.npz"
    )
    assert status == 2
    assert (
        "The features of 'spoilt' must be L2-normalized. Got norm 2 in 1 row (3). Pass --normalize yes"
        in err
    )


def test_features_that_rounding_cannot_tell_apart_are_refused(capsys, sets):
    np.savez(
        "huge.npz", features=sets["far"].features * 1e30, ids=np.array(IDS), groups=np.array(GROUPS)
    )
    status, _, err = call(
        capsys,
        "--generated",
        "huge.npz",
        "--reference",
        "real.npz",
        "--normalize",
        "no",
        "--companions",
        "none",
    )
    assert status == 2
    assert "wide enough for rounding to tell the rows' distances" in err
