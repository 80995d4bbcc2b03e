"""Core: errors, digests, files, splits, scores, features, stages."""

import itertools
import json
import os
import pickle
import shutil

import numpy as np
import pytest

from forge.errors import fails
from palpate.core import (
    FeatureSet,
    MissingExtraError,
    Note,
    PalpateError,
    Problem,
    ProblemsError,
    Score,
    Split,
    atomic_folder,
    atomic_path,
    digest_folder,
    digest_json,
    inside,
    plain,
    read_record,
    reading_entry,
    require_comparable,
    rng_for,
    seed_for,
)
from palpate.core.features import to_numpy
from palpate.report.tables import columns
from palpate.studies.stages import run_stage

PROBLEMS = [Problem("a:1", "bad-line", "x"), Problem("a:2", "bad-line", "y")]


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (PalpateError("A ratio must lie in (0, 1)", "1.5", "Fix."), "(0, 1). Got 1.5. Fix."),
        (
            PalpateError("must lie in (0, 1)", "2", "", argument="val", example={"val": 0.1}),
            "`val` must lie in (0, 1). Got 2. E.g. val=0.1",
        ),
        (
            ProblemsError(PROBLEMS, "Fix them"),
            "Got 2 problems: 2 bad-line. Fix them.\n  a:1: x\n  a:2: y",
        ),
        (
            MissingExtraError("av", "video", "Video"),
            "In palpate's checkout run: pip install -e '.[video]'",
        ),
    ],
)
def test_an_error_says_must_got_fix_and_survives_pickling(error, text):
    assert str(error).endswith(text)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.to_json()) == (str(error), error.to_json())


def test_seeds_depend_on_names_alone_and_are_the_same_in_every_version():
    assert seed_for(0, "noise", "a/1") == seed_for(0, "noise", "a/1") != seed_for(0, "noise", "a/2")
    assert seed_for(0, "ab", "c") != seed_for(0, "a", "bc")
    # A change here would change every generated image.
    assert seed_for(0, "noise", "a/1") == 7037779842902421232
    assert rng_for(1, "x").random() == rng_for(1, "x").random()


def test_a_folder_of_names_in_another_encoding_has_a_digest(tmp_path):
    digests = set()
    for name in (b"caf\xe9", b"caf\xe8"):
        folder = tmp_path / name.hex()
        folder.mkdir()
        (folder / os.fsdecode(name)).write_bytes(b"1")
        digests |= {digest_folder(folder), digest_json([os.fsdecode(name)])}
    assert len(digests) == 4


def test_digests_are_canonical():
    assert digest_json({"a": 1, "b": (1, 2)}) == digest_json({"b": [1, 2], "a": np.int64(1)})
    with pytest.raises(ValueError, match="JSON"):
        digest_json(float("nan"))


def test_values_become_plain_json():
    value = {1: np.float32(0.5), "x": (np.arange(2), float("nan")), "note": Note("a", {"b": {1}})}
    expected = {"1": 0.5, "x": [[0, 1], None], "note": {"code": "a", "params": {"b": [1]}}}
    assert plain(value) == expected
    with pytest.raises(TypeError, match="object"):
        plain(object())


def test_atomic_writing_leaves_nothing_half(tmp_path):
    def write_and_fail(context, write):
        with context as part:
            write(part)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_and_fail(atomic_path(tmp_path / "a.txt"), lambda part: part.write_text("half"))
    with pytest.raises(RuntimeError):
        write_and_fail(atomic_folder(tmp_path / "b"), lambda part: (part / "x").write_text("half"))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    with pytest.raises(PalpateError, match="empty folder"), atomic_folder(tmp_path / "full"):
        pass


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "must exist"),
        ("{", "must be JSON"),
        ("[1]", "must be a JSON object"),
        ('{"format": "x"}', "must have the format a/2"),
        ('{"format": "a/1"}', "must have the keys k"),
        ('{"format": "a/2", "k": NaN}', "not JSON compliant"),
    ],
)
def test_records_that_cannot_be_read(tmp_path, text, words):
    path = tmp_path / "r.json"
    if text is not None:
        path.write_text(text)
    fails(words, read_record, path, "card", form=("a/2", "a/1"), keys=["k"])
    words = r"sizes in .* must be as palpate writes it"
    with pytest.raises(PalpateError, match=words), reading_entry(path, "sizes"):
        int("x")


@pytest.mark.parametrize(
    ("given", "wanted", "words"),
    [
        (
            "palpate-split/1",
            "palpate-results/1",
            "r.json, a split. .* for palpate audit DATA --split",
        ),
        ("palpate/preference@1", "palpate-split/1", "a study. .* for palpate preference score"),
        ("palpate-results/9", "palpate-results/1", "'palpate-results/9'.* install the release"),
        ("elsewhere/1", "palpate-results/1", "'elsewhere/1'.* install the release"),
    ],
)
def test_a_file_of_another_kind_is_said_to_be_one(tmp_path, given, wanted, words):
    path = tmp_path / "r.json"
    path.write_text(json.dumps({"format": given}))
    fails(words, read_record, path, "file", form=wanted)


def test_a_folder_of_another_kind_is_said_to_be_one(tmp_path):
    (tmp_path / "manifest.parquet").write_bytes(b"PAR1\x81")
    for path in (tmp_path, tmp_path / "palpate.json", tmp_path / "manifest.parquet"):
        with pytest.raises(PalpateError, match=r"a manifest\. Name another one: .* palpate audit"):
            read_record(path, "card", form="palpate-pipeline/1")
    (tmp_path / "palpate.json").write_text('{"format": "palpate-pipeline/1"}')
    with pytest.raises(PalpateError, match=r"a generator\. .* for palpate generate PHOTO --model"):
        read_record(tmp_path / "index.json", "index")


def test_a_path_may_not_climb_out(tmp_path):
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "link").symlink_to(tmp_path)
    assert inside(tmp_path / "root", "a/../b.png") == (tmp_path / "root" / "b.png").resolve()
    for bad in ("../x", "a/../../x", "/etc/passwd", "link/x"):
        assert inside(tmp_path / "root", bad) is None


def test_a_split_comes_back_from_its_file_unless_edited(tmp_path):
    split = Split(
        {"a": "train", "b": "train", "c": "test"}, {"name": "x"}, "m", [Note("n", {"k": 1})]
    )
    assert Split.load(split) is split
    split.save(tmp_path / "s.json")
    again = Split.load(str(tmp_path / "s.json"))
    assert (again, again.digest, len(again)) == (split, split.digest, 3)
    assert again.counts() == {"train": 2, "test": 1}
    assert str(again) == f"x: train 2, test 1 (digest {split.digest[:12]})"
    data = json.loads((tmp_path / "s.json").read_text())
    data["parts"]["train"].remove("a")
    (tmp_path / "s.json").write_text(json.dumps(data))
    for words, attempt in {
        "edited by hand": lambda: Split.load(tmp_path / "s.json"),
        "must be a split or its file": lambda: Split.load({"a": "train"}),
        "must exist": lambda: Split.load(tmp_path / "absent.json"),
        "one part only": lambda: Split.from_ids(train=["a"], test=["a"]),
        "train, val, test": lambda: Split({"a": "holdout"}),
    }.items():
        fails(words, attempt)


def test_a_score_is_a_number_that_prints_how_it_was_made():
    score = Score(
        "TMMD", "a", 1.23456, (1.0, 1.5), interval_method="jackknife", n=9, encoder="e" * 64
    )
    assert (float(score), f"{score:.2f}", round(score, 1)) == (1.23456, "1.23", 1.2)
    first, _, last = str(score).splitlines()
    assert first == "TMMD of a: 1.235 [1, 1.5] (95%, jackknife)"
    assert last.strip() == f"9 samples, encoder {'e' * 12}"
    again = Score.from_json(json.loads(json.dumps(score.to_json())))
    assert again == score
    inf, nan = float("inf"), float("nan")
    lost = Score("TMMD", "a", inf, interval=(0.0, inf), null=(nan, 1.0), floor=-inf)
    assert (lost.value, lost.interval, lost.null, lost.floor) == (None,) * 4
    assert Score.from_json(lost.to_json()) == lost
    low, high = Score("TMMD", "a", 1.0), Score("TMMD", "a", 2.0)
    assert max([low, high]) is high
    assert low < 1.5 < high
    assert not low < lost  # an undefined one compares with none
    assert not low > lost


@pytest.mark.parametrize("change", [{"bandwidth": 5.0}, {"encoder": "e2"}, {"settings": {"k": 1}}])
def test_scores_of_different_settings_share_no_column(change):
    a = Score("TMMD", "ours", 1.0, bandwidth=10.0, encoder="e1")
    same = Score("TMMD", "theirs", 2.0, bandwidth=10.0, encoder="e1")
    assert [len(c) for c in columns([a, same, Score("SSIM", "ours", 0.5)])] == [2, 1]
    fields = {"bandwidth": 10.0, "encoder": "e1"} | change
    fails(next(iter(change)), columns, [a, Score("TMMD", "theirs", 2.0, **fields)])


def test_references_must_agree_where_they_are_known():
    unknown, one, two = (Score("TMMD", "g", 1.0, reference=r) for r in (None, "r1", "r2"))
    for fine in ([], [unknown], [unknown, one], [one, unknown, one], [unknown, two, unknown, two]):
        require_comparable(fine)
    for order in itertools.permutations([unknown, unknown, one, two]):
        fails(r"agree in reference. Got '(r1|r2)' for 'g' and", require_comparable, order)
    with pytest.raises(PalpateError, match="encoder"):  # elsewhere unknown is a value
        require_comparable([Score("TMMD", "g", 1.0, encoder="e"), unknown])


def test_the_digest_of_features_is_of_ids_and_values_in_any_order(tmp_path):
    ids = [f"v/{k}" for k in range(9)]
    x = np.random.default_rng(0).normal(size=(9, 4)).astype(np.float32)
    digest = FeatureSet(ids, x).digest
    order = np.random.default_rng(1).permutation(9)
    np.save(tmp_path / "x.npy", x)
    for same in (
        FeatureSet([ids[k] for k in order], x[order]),
        FeatureSet(ids, np.asfortranarray(x)),
        FeatureSet(ids, x.astype(np.float64)),
        FeatureSet(ids, np.load(tmp_path / "x.npy", mmap_mode="r")),
        FeatureSet(ids, x, labels=["a"] * 9, groups=["b"] * 9, encoder="e"),
    ):
        assert same.digest == digest
    bit = x.copy()
    bit[8, 3] = np.nextafter(bit[8, 3], np.float32(9))
    others = [
        FeatureSet(ids, bit),
        FeatureSet([*ids[:8], "v/9"], x),
        FeatureSet([ids[1], ids[0], *ids[2:]], x),
        FeatureSet(ids[:8], x[:8]),
        FeatureSet(ids, x[:, :3]),
        FeatureSet(["v/0v/1", "", *ids[2:]], x),
    ]
    assert len({digest, *(s.digest for s in others)}) == 7
    two = [FeatureSet(["a", "b"], np.array([[z, 1.0], [1.0, z]])).digest for z in (0.0, -0.0)]
    assert two[0] == two[1]  # equal numbers
    assert FeatureSet([], np.zeros((0, 3))).digest != FeatureSet([], np.zeros((0, 4))).digest
    ids, x = [f"{k}" for k in range(8200)], np.arange(8200, dtype=np.float32)[:, None]
    digest = FeatureSet(ids, x).digest  # of several blocks
    assert FeatureSet(ids[::-1], x[::-1]).digest == digest
    x[-1] += 1
    assert FeatureSet(ids, x).digest != digest


def test_features_come_back_from_their_file_and_from_tensors(tmp_path):
    torch = pytest.importorskip("torch")
    rows = torch.eye(2, requires_grad=True)  # copied to the host, bfloat16 widened
    assert to_numpy(rows).tolist() == [[1, 0], [0, 1]]
    assert FeatureSet(["a", "b"], rows.bfloat16()).features.dtype == np.float32
    x = np.eye(3, dtype=np.float32)
    features = FeatureSet(["a", "b", "c"], x, ["w", "w", "g"], ["v", "v", "u"], "e")
    features.save(tmp_path / "f.npz")
    again = FeatureSet.load(tmp_path / "f.npz").take(["c", "a"])
    assert (again.labels, again.groups, again.encoder) == (["g", "w"], ["u", "v"], "e")
    assert np.array_equal(again.features, x[[2, 0]])
    fails("missing, first 'z'", features.take, ["z"])


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ([["1", "2"]], "must be numbers"),
        ([[None, 2.0]], "must be numbers"),
        ([[1.0, 2.0], [3.0]], "must turn into an array"),
        ([1.0], r"must have shape \(1, d\)"),
        ([[1.0], [2.0]], r"must have shape \(1, d\)"),
        ([[np.nan]], r"NaN or infinity in 1 row \(0: 'a'\)"),
    ],
)
def test_features_that_cannot_be(features, words):
    fails(words, FeatureSet, ["a"], features)
    with pytest.raises(PalpateError, match="`labels` must have one entry per row"):
        FeatureSet(["a"], np.ones((1, 2)), labels=["x", "y"])


def test_a_stage_is_built_once_and_again_for_other_inputs(tmp_path):
    calls = []

    def build(folder):
        calls.append(1)
        return {"n": len(calls)}

    first = run_stage(tmp_path / "a", {"k": 1}, build)
    again = run_stage(tmp_path / "a", {"k": 1}, build)
    assert (first.facts, again.facts, len(calls)) == ({"n": 1}, {"n": 1}, 1)
    other = run_stage(tmp_path / "a", {"k": 2}, build)
    assert (other.facts, len(calls)) == ({"n": 2}, 2)
    assert other.digest != first.digest
    run_stage(tmp_path / "a", {"k": 2}, build, read={"b": "0" * 64})
    assert len(calls) == 3


def test_a_stage_killed_after_its_mark_has_the_digest_of_its_files(tmp_path):
    def build(folder):
        (folder / "text").write_text("x")

    whole = run_stage(tmp_path / "whole" / "a", {}, build)
    record = tmp_path / "whole" / "a" / "stage.json"
    shutil.copytree(whole.folder, tmp_path / "run" / "a.partial")  # killed before it was renamed
    shutil.copy(record, tmp_path / "run" / "a.partial.json")
    assert run_stage(tmp_path / "run" / "a", {}, build).outputs == whole.outputs


@pytest.mark.parametrize(("inputs", "resumed"), [({"k": 1}, True), ({"k": 2}, False)])
def test_a_killed_stage_resumes_for_the_same_inputs_only(tmp_path, inputs, resumed):
    def killed(folder):
        (folder / "checkpoint").write_text("half")
        raise KeyboardInterrupt

    def reject(folder):
        raise PalpateError("a", "b", "c")

    with pytest.raises(PalpateError):
        run_stage(tmp_path / "a", {}, reject)
    assert list(tmp_path.iterdir()) == []  # a rejected input leaves no partial folder
    with pytest.raises(KeyboardInterrupt):
        run_stage(tmp_path / "a", {"k": 1}, killed)
    assert not (tmp_path / "a").exists()
    build = lambda folder: {"resumed": (folder / "checkpoint").exists()}
    assert run_stage(tmp_path / "a", inputs, build).facts == {"resumed": resumed}
