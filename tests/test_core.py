"""Core: errors, digests, files, splits, scores, features, stages."""

import itertools
import json
import pickle
import warnings

import numpy as np
import pytest

from palpate.core import (
    FeatureSet,
    MissingExtraError,
    PalpateError,
    Problem,
    ProblemsError,
    Run,
    Score,
    Split,
    atomic_folder,
    atomic_path,
    columns,
    digest_json,
    inside,
    require_comparable,
    rng_for,
    seed_for,
)


def test_an_error_is_one_line_of_must_got_fix():
    error = PalpateError("--ratio must lie in (0, 1)", "1.5", "Pass 0.8")
    assert str(error) == "--ratio must lie in (0, 1). Got 1.5. Pass 0.8."
    many = ProblemsError(
        [Problem("a:1", "bad-line", "x"), Problem("a:2", "bad-line", "y")], "Mend them"
    )
    assert "2 problems: 2 bad-line" in str(many)
    assert many.to_json()["problems"] == [
        {"where": "a:1", "kind": "bad-line", "text": "x"},
        {"where": "a:2", "kind": "bad-line", "text": "y"},
    ]


def test_errors_survive_pickling_as_worker_processes_need():
    for error in (
        PalpateError("m", "g", "f"),
        ProblemsError([Problem("a:1", "k", "t")], "f"),
        MissingExtraError("av", "video", "x"),
    ):
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), str(again), again.to_json()) == (
            type(error),
            str(error),
            error.to_json(),
        )


def test_seeds_depend_on_names_alone_and_are_stable_across_versions():
    assert seed_for(0, "noise", "a/1") == seed_for(0, "noise", "a/1") != seed_for(0, "noise", "a/2")
    assert seed_for(0, "ab", "c") != seed_for(0, "a", "bc")
    assert (
        seed_for(0, "noise", "a/1") == 7037779842902421232
    )  # a change here would change every generated image
    assert rng_for(1, "x").random() == rng_for(1, "x").random()


def test_digests_are_canonical():
    assert digest_json({"a": 1, "b": (1, 2)}) == digest_json({"b": [1, 2], "a": np.int64(1)})
    with pytest.raises(ValueError, match="JSON"):
        digest_json(float("nan"))


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


def test_a_path_may_not_climb_out(tmp_path):
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "link").symlink_to(tmp_path)
    assert inside(tmp_path / "root", "a/../b.png") == (tmp_path / "root" / "b.png").resolve()
    for bad in ("../x", "a/../../x", "/etc/passwd", "link/x"):
        assert inside(tmp_path / "root", bad) is None


def test_split_round_trip_and_tampering(tmp_path):
    split = Split.from_ids(train=["a", "b"], test=["c"], rule={"name": "x"})
    split.save(tmp_path / "s.json")
    again = Split.load(tmp_path / "s.json")
    assert again.digest == split.digest
    assert again.counts() == {"train": 2, "test": 1}
    data = json.loads((tmp_path / "s.json").read_text())
    data["parts"]["train"].remove("a")
    (tmp_path / "s.json").write_text(json.dumps(data))
    with pytest.raises(PalpateError, match="edited by hand"):
        Split.load(tmp_path / "s.json")
    with pytest.raises(PalpateError, match="one part only"):
        Split.from_ids(train=["a"], test=["a"])
    with pytest.raises(PalpateError, match="train, val, test"):
        Split({"a": "holdout"})
    with pytest.raises(PalpateError, match="must exist"):
        Split.load(tmp_path / "absent.json")


def test_incomparable_scores_refuse_one_column():
    a = Score("TMMD", "ours", 1.0, bandwidth=10.0, encoder="e1")
    assert columns(
        [a, Score("TMMD", "theirs", 2.0, bandwidth=10.0, encoder="e1"), Score("SSIM", "ours", 0.5)]
    ).keys() == {"TMMD", "SSIM"}
    with pytest.raises(PalpateError, match="bandwidth"):
        columns([a, Score("TMMD", "theirs", 2.0, bandwidth=5.0, encoder="e1")])
    with pytest.raises(PalpateError, match="encoder"):
        columns([a, Score("TMMD", "theirs", 2.0, bandwidth=10.0, encoder="e2")])


def test_scores_against_other_references_refuse_one_column_wherever_they_stand():
    unknown, one, two = (Score("TMMD", "g", 1.0, reference=r) for r in (None, "r1", "r2"))
    for fine in (
        [],
        [unknown],
        [one],
        [unknown, unknown],
        [unknown, one],
        [one, unknown],
        [one, unknown, one],
        [unknown, two, unknown, two],
    ):
        require_comparable(fine)
    for places in itertools.permutations([unknown, unknown, one, two]):
        with pytest.raises(
            PalpateError,
            match=r"agree in reference. Got '(r1' for 'g' and 'r2|r2' for 'g' and 'r1)' for 'g'",
        ):
            require_comparable(places)
    with pytest.raises(PalpateError, match="reference"):
        require_comparable([one, one, two])
    with pytest.raises(
        PalpateError, match="encoder"
    ):  # for what is not a reference, unknown is a value of its own
        require_comparable([Score("TMMD", "g", 1.0, encoder="e"), unknown])


def test_the_digest_of_features_is_of_ids_and_values_in_any_order():
    ids, x = (
        [f"v/{k}" for k in range(9)],
        np.random.default_rng(0).normal(size=(9, 4)).astype(np.float32),
    )
    digest = FeatureSet(ids, x).digest
    assert len(digest) == 64
    assert int(digest, 16) >= 0
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(9)
        assert FeatureSet([ids[k] for k in order], x[order]).digest == digest
    assert (
        FeatureSet(ids, np.asfortranarray(x)).digest
        == FeatureSet(ids, np.repeat(x, 2, axis=0)[::2]).digest
        == digest
    )
    assert FeatureSet(ids, x, labels=["a"] * 9, groups=["b"] * 9, encoder="e").digest == digest
    bit, renamed, swapped = x.copy(), [*ids[:8], "v/9"], [ids[1], ids[0], *ids[2:]]
    bit[8, 3] = np.nextafter(bit[8, 3], np.float32(9))
    others = [
        FeatureSet(ids, bit),
        FeatureSet(renamed, x),
        FeatureSet(swapped, x),
        FeatureSet(ids[:8], x[:8]),
        FeatureSet(ids, x[:, :3]),
        FeatureSet(["v/0v/1", "", *ids[2:]], x),
    ]
    assert len({digest, *(s.digest for s in others)}) == 7
    assert FeatureSet(ids, x.astype(np.float64)).digest == digest  # the same numbers


def test_every_slab_counts_in_the_digest():
    """More rows than are hashed at a time: the last one counts, and order does not."""
    ids, x = [f"{k}" for k in range(8200)], np.arange(8200, dtype=np.float32)[:, None]
    digest = FeatureSet(ids, x).digest
    assert FeatureSet(ids[::-1], x[::-1]).digest == digest
    other = x.copy()
    other[sorted(range(8200), key=lambda k: ids[k])[-1]] += 1
    assert FeatureSet(ids, other).digest != digest


def test_numbers_that_are_equal_have_one_digest():
    ids = ["a", "b"]
    digest = FeatureSet(ids, np.array([[0.0, 1.0], [1.0, 0.0]])).digest
    assert FeatureSet(ids, np.array([[-0.0, 1.0], [1.0, -0.0]])).digest == digest
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert FeatureSet(ids, np.array([[1e300, 1.0], [1.0, 0.0]])).digest != digest
    assert FeatureSet([], np.zeros((0, 3))).digest != FeatureSet([], np.zeros((0, 4))).digest


def test_tensors_of_half_precision_are_widened_and_it_is_said():
    torch = pytest.importorskip("torch")
    rows = torch.eye(2)
    with pytest.warns(
        UserWarning, match="bfloat16 features were widened to float32; their rounding stays"
    ):
        assert FeatureSet(["a", "b"], rows.bfloat16()).features.dtype == np.float32
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FeatureSet(["a", "b"], rows)


def test_features_name_the_bad_row_and_round_trip(tmp_path):
    x = np.eye(3, dtype=np.float32)
    features = FeatureSet(
        ["a", "b", "c"], x, labels=["w", "w", "g"], groups=["v", "v", "u"], encoder="e"
    )
    features.save(tmp_path / "f.npz")
    again = FeatureSet.load(tmp_path / "f.npz").take(["c", "a"])
    assert again.labels == ["g", "w"]
    assert again.encoder == "e"
    assert np.array_equal(again.features, x[[2, 0]])
    with pytest.raises(PalpateError, match=r"NaN or infinity in 1 row \(1: 'b'\)"):
        FeatureSet(["a", "b", "c"], np.where(np.arange(3)[:, None] == 1, np.nan, x))
    with pytest.raises(PalpateError, match="without, first 'z'"):
        features.take(["z"])
    column = pytest.importorskip("pandas").Series(["a", "b"], index=[5, 6])
    with pytest.raises(PalpateError, match=r"1 row \(1: 'b'\)"):
        FeatureSet(column, np.array([[1.0], [np.nan]]))


def test_a_stage_is_built_once_and_again_for_other_inputs(tmp_path):
    calls = []

    def build(folder):
        calls.append(1)
        (folder / "out.txt").write_text("x")
        return {"n": len(calls)}

    first = Run(tmp_path).stage("a", {"k": 1}, build)
    again = Run(tmp_path).stage("a", {"k": 1}, build)
    assert (first.facts, again.facts, again.reused, len(calls)) == ({"n": 1}, {"n": 1}, True, 1)
    other = Run(tmp_path).stage("a", {"k": 2}, build)
    assert (other.facts, len(calls)) == ({"n": 2}, 2)
    assert other.digest != first.digest


def test_a_killed_stage_keeps_its_partial_folder_for_the_same_inputs_only(tmp_path):
    def killed(folder):
        (folder / "checkpoint").write_text("half")
        raise KeyboardInterrupt

    for inputs, found in (({"k": 1}, True), ({"k": 2}, False)):
        with pytest.raises(KeyboardInterrupt):
            Run(tmp_path).stage("a", {"k": 1}, killed)
        assert not (tmp_path / "a").exists()
        seen = []
        Run(tmp_path).stage(
            "a", inputs, lambda folder, seen=seen: seen.append((folder / "checkpoint").exists())
        )
        assert seen == [found]
        for path in (tmp_path / "a").iterdir():
            path.unlink()
        (tmp_path / "a").rmdir()


def test_a_refused_input_leaves_no_partial_folder(tmp_path):
    def refuse(folder):
        raise PalpateError("a", "b", "c")

    with pytest.raises(PalpateError):
        Run(tmp_path).stage("a", {}, refuse)
    assert list(tmp_path.iterdir()) == []


def test_the_digest_of_features_on_disk_is_that_of_the_same_numbers_in_memory(tmp_path):
    x = np.random.default_rng(0).normal(size=(20_000, 3)).astype(np.float32)
    np.save(tmp_path / "x.npy", x)
    ids = [str(k) for k in range(len(x))]
    wanted = FeatureSet(ids, x).digest
    assert FeatureSet(ids, np.load(tmp_path / "x.npy", mmap_mode="r")).digest == wanted
    assert FeatureSet(ids, x.astype(">f8")).digest == wanted
    x[19_999, 2] += 1
    assert FeatureSet(ids, x).digest != wanted


@pytest.mark.parametrize(
    "features", [[["1", "2"]], [[None, 2.0]], np.array([[1, "a"]], dtype=object)]
)
def test_features_that_are_no_numbers_are_refused(features):
    with pytest.raises(PalpateError, match="Features must"):
        FeatureSet(["a"], features)
