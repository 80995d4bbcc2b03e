"""Verifying: planted changes of inputs and numbers are named, and nothing else is."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import palpate as pp
from forge.pictures import paint
from forge.results import edit
from forge.scores import GROUPS, IDS, LABELS, feature_sets
from palpate.core import FeatureSet, PalpateError, Split
from palpate.data.manifest import Manifest
from palpate.report.results import Audit, Results
from palpate.studies.verifying import TOLERANCE, difference, verify


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    folder, call = tmp_path_factory.mktemp("scored"), {"companions": ["fid"], "permutations": 9}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, features in feature_sets().items():
            features.save(Path(f"{name}.npz"))
        pp.score(["near.npz", "far.npz"], "real.npz", **call).save("out/scores.json")
    return folder


@pytest.fixture
def vectors(scored, tmp_path, monkeypatch):
    """``real.npz``, ``near.npz`` and ``far.npz`` in the working directory, scored."""
    shutil.copytree(scored, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return Path("out/scores.json")


@pytest.fixture
def images(tmp_path, monkeypatch):
    """Folders ``real`` and ``made`` of twelve images, scored by their pixels."""
    monkeypatch.chdir(tmp_path)
    names = [f"v{k // 3}/{k}" for k in range(12)]
    for seed, folder in enumerate(("real", "made")):
        paint(Path(folder), names, seed)
    pp.score("made", "real", companions=["ssim", "psnr"]).save("scores.json")
    return Path("scores.json")


def differing(file, **options):
    return {c.name: c.why for c in verify(file, **options).checks if c.status == "differs"}


def test_all_numbers_of_an_untouched_file_are_the_same(vectors):
    checked = verify(vectors)
    scores = Results.load(vectors).scores
    assert checked.ok
    assert {c.status for c in checked.checks} == {"same"}
    # Every score, the paired differences as well, and the call with the digests of its inputs.
    assert len(checked.checks) == len(scores) + 1 > 20
    assert checked.checks[0].name == "call score"


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("value", lambda s: s["value"] + 1e-4, "value"),
        ("interval", lambda s: [s["interval"][0], s["interval"][1] + 0.01], "interval"),
        ("n", lambda s: s["n"] + 1, "n 48 in the file"),
        ("reference", lambda s: "0" * 64, "reference 000000000000"),
        ("bandwidth", lambda s: 11.0, "bandwidth 11 in the file, 10 now"),
    ],
)
def test_an_edited_field_of_one_score_is_named(vectors, field, value, words):
    def change(data):
        score = next(s for s in data["scores"] if s["metric"] == "TMMD" and s["interval"])
        score[field] = value(score)

    before = json.loads(vectors.read_text())["scores"]
    first = next(s for s in before if s["metric"] == "TMMD" and s["interval"])
    words = words.replace("48", str(first["n"] + 1))
    edit(vectors, change)
    (name,) = differing(vectors)
    assert name == f"TMMD of {first['a']} ({first['settings']['preset']})"
    assert words in differing(vectors)[name]


def test_an_edited_cell_of_a_matrix_is_named(vectors):
    def change(data):
        score = next(s for s in data["scores"] if s["details"].get("matrix"))
        score["details"]["matrix"][0][1] += 0.5

    kept = next(s for s in Results.load(vectors).scores if s.details.get("matrix"))
    edit(vectors, change)
    (why,) = differing(vectors).values()
    assert kept.details["matrix"][0][1] != 0
    assert why.startswith("details matrix 1 ")


def test_numbers_added_and_removed_by_hand_are_named(vectors):
    def change(data):
        data["scores"].append({"metric": "TMMD", "a": "mine", "value": 0.0})
        data["scores"].pop(0)

    first = Results.load(vectors).scores[0]
    edit(vectors, change)
    assert differing(vectors) == {
        f"{first.metric} of {first.a} (grouped)": "not in the file",
        "TMMD of mine": "in the file, not made again",
    }
    assert not verify(vectors).ok


def test_a_results_folder_moves_with_its_inputs(vectors, tmp_path, monkeypatch):
    place = tmp_path.parent / f"{tmp_path.name}-moved"
    tmp_path.rename(place)
    monkeypatch.chdir("/")
    assert verify(place / vectors).counts["same"] > 20
    assert verify(place / vectors).ok
    shutil.copy(place / vectors, place / "elsewhere.json")  # no longer one folder below
    counts = verify(place / "elsewhere.json").counts
    assert counts["same"] == counts["differs"] == 0


def test_a_missing_input_cannot_be_checked_and_says_which(vectors):
    Path("far.npz").unlink()
    checked = verify(vectors)
    assert checked.ok is None
    assert {c.status for c in checked.checks} == {"cannot check"}
    assert "nothing at far.npz" in str(checked)


def test_arrays_in_memory_cannot_be_checked(tmp_path):
    x = np.random.default_rng(0).normal(size=(2, 40, 8))
    options = {"normalize": True, "companions": [], "permutations": 0}
    pp.score(x[0], x[1], **options).save(tmp_path / "s.json")
    checked = verify(tmp_path / "s.json")
    assert checked.counts["cannot check"] == len(checked.checks) > 0
    assert "ndarray in memory" in str(checked)


def test_a_manifest_in_memory_is_read_from_its_folder_while_that_says_the_same(images):
    rows = [{"id": f"v{k // 3}/{k}", "tactile": f"v{k // 3}/{k}.png"} for k in range(12)]
    Manifest.from_rows(rows, Path("real")).save(Path("real/manifest.parquet"))
    real = Manifest.load(Path("real"))
    made = {"ours": Path("made")}
    pp.score(made, real, companions=["psnr"]).save("m.json")
    assert verify("m.json").counts["same"] == len(verify("m.json").checks)
    Manifest.from_rows(rows[::-1], Path("real")).save(Path("real/manifest.parquet"))
    assert list(differing("m.json")) == ["call score"]


def test_one_changed_pixel_of_one_image_is_found(images):
    assert verify(images).ok
    file = Path("made/v1/4.png")
    with Image.open(file) as image:
        pixels = np.array(image)
    pixels[7, 7, 0] ^= 64
    Image.fromarray(pixels).save(file)
    changed = differing(images)
    assert changed["call score"].startswith("digests generated made")
    assert {"SSIM of made", "PSNR of made"} <= {*changed}


def test_an_edited_split_is_found(images):
    ids = sorted(f"v{k // 3}/{k}" for k in range(12))
    split = lambda test: Split.from_ids(
        train=[i for i in ids if i not in test], test=test, rule={}, manifest="m"
    )
    split(ids[:6]).save(Path("split.json"))
    pp.score("made", "real", split="split.json", companions=["psnr"]).save("s.json")
    assert verify("s.json").ok
    split(ids[:5]).save(Path("split.json"))
    changed = differing(Path("s.json"))
    assert changed["call score"].startswith("arguments split $digest")
    assert any(name.startswith("PSNR") for name in changed)
    edit(Path("split.json"), lambda data: data["parts"].popitem())  # by hand: no split any more
    assert {c.status for c in verify("s.json").checks} == {"cannot check"}


def test_numbers_within_the_tolerance_are_the_same(vectors):
    edit(vectors, lambda data: data["scores"][0].update(value=1.001 * data["scores"][0]["value"]))
    assert len(differing(vectors)) == 1
    assert not differing(vectors, tolerance=0.01)
    with pytest.raises(PalpateError, match=r"tolerance.*must lie in \[0, 1\)"):
        verify(vectors, tolerance=1.0)


SIZE = {"kind": "effect size", "value": 0.3019, "p_adjusted": 0.8177, "n": 3.0}


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ({"value": 1.0}, {"value": 1.0 + 5e-7}, True),
        ({"value": 1.0}, {"value": 1.0 + 5e-6}, False),
        ({"value": 0.0}, {"value": 5e-7}, True),  # of small numbers the sixth decimal
        ({"value": 0.0}, {"value": 5e-6}, False),
        ({"value": None}, {"value": 0.0}, False),
        ({"value": None}, {"value": None}, True),
        # What threads make of effect sizes, p-values and thresholds of near-duplicates.
        (SIZE, {"value": 0.3014}, True),
        (SIZE, {"value": 0.31}, False),
        (SIZE | {"kind": "difference"}, {"value": 0.3014}, False),
        (SIZE | {"kind": "difference"}, {"p_adjusted": 0.8174}, True),
        (SIZE, {"p_adjusted": 0.83}, False),
        (SIZE | {"kind": "difference"}, {"n": 3.001}, False),
        ({"threshold": 0.78549515}, {"threshold": 0.7855167}, True),
        ({"threshold": 0.78549515}, {"threshold": 0.7865}, False),
        ({"rate": 0.78549515}, {"rate": 0.7855167}, False),
    ],
)
def test_numbers_are_the_same_within_the_tolerance_of_their_kind(before, after, same):
    assert (not difference(before, before | after, TOLERANCE)) == same


@pytest.fixture
def audited(tmp_path, monkeypatch):
    """Two lists, where one video is in both, and their audit."""
    monkeypatch.chdir(tmp_path)
    Path("train.txt").write_text("a/0000000001.jpg,3\nb/0000000001.jpg,4")
    Path("test.txt").write_text("a/0000000005.jpg,3\nc/0000000001.jpg,4")
    pp.audit("train.txt", "test.txt").save("audit.json")
    return Path("audit.json")


def test_counts_of_an_audit_are_made_again(audited):
    assert verify(audited).ok

    def change(data):
        signal = next(s for s in data["signals"] if s["kind"] == "time gap")
        signal["flagged"] = 0

    edit(audited, change)
    [(name, why)] = differing(audited).items()
    assert name == "audit train.txt / test.txt"
    assert why.endswith("flagged 0 in the file, 1 now")
    edit(audited, lambda data: data.update(gap_min=40))
    assert differing(audited) == {name: "gap min 40 in the file, 4 now"}


def test_a_changed_list_is_found(audited):
    Path("test.txt").write_text("d/0000000005.jpg,3\nc/0000000001.jpg,4")
    changed = differing(audited)
    assert {*changed} == {"audit train.txt / test.txt"}


def test_an_audit_without_its_call_cannot_be_checked(audited):
    audit = Audit.load(audited)
    replace(audit, call=None).save(audited)
    checked = verify(audited)
    assert checked.counts["cannot check"] == len(checked.checks) == 1
    assert "no call in the file makes it" in str(checked)


def test_a_report_of_several_files_is_verified_by_all_their_calls(vectors, audited, capsys):
    from palpate.cli import main

    args = ["report", str(vectors), str(audited), "-o", "pages/page.html", "-q"]
    assert main(args) == 0
    file = Path("pages/page.json")
    alone = verify(vectors).counts["same"] + verify(audited).counts["same"]
    assert verify(file).counts == {"same": alone, "differs": 0, "cannot check": 0}
    edit(file, lambda data: data["audits"][0].update(groups_shared=0))
    assert differing(file) == {"audit train.txt / test.txt": "groups shared 0 in the file, 1 now"}


def test_the_call_of_another_verb_cannot_be_made(vectors):
    edit(vectors, lambda data: data["calls"][0].update(verb="world"))
    checked = verify(vectors)
    assert checked.counts["same"] == 0
    assert "The verb of a call must be one of" in str(checked)


@pytest.mark.parametrize(
    "arguments",
    [{}, {"generated": 3}, {"nonsense": 1}, {"generated": {"$path": 7}}, {"generated": [[[]]]}],
)
def test_an_edited_call_gives_a_reason(vectors, arguments):
    edit(vectors, lambda data: data["calls"][0].update(arguments=arguments))
    checked = verify(vectors)
    assert checked.counts["cannot check"] > 20
    assert checked.counts["same"] == 0


def test_labels_in_memory_are_no_paths(vectors):
    Path("Wood").touch()
    labels = dict(zip(IDS, LABELS, strict=True))
    x = FeatureSet(IDS, np.load("near.npz")["features"], None, GROUPS, None)
    x.save(Path("x.npz"))
    pp.score("x.npz", "real.npz", labels=labels, companions=[], permutations=0).save("l.json")
    assert "dict in memory" in str(verify("l.json"))


@pytest.mark.slow
def test_a_swapped_encoder_is_found_and_a_probe_made_again(tmp_path, monkeypatch):
    import torch

    from palpate.encoders import EncoderSet

    monkeypatch.chdir(tmp_path)
    paint(Path("real"), [f"t{k}" for k in range(12)], 0)
    paint(Path("real"), [f"p{k}" for k in range(12)], 1)
    rows = [
        {
            "id": f"{k}",
            "video": f"v{k // 2}",
            "material": ["Wood", "Brick"][k % 2],
            "tactile": f"t{k}.png",
            "vision": f"p{k}.png",
        }
        for k in range(12)
    ]
    Manifest.from_rows(rows, Path("real")).save(Path("real/manifest.parquet"))
    Split.from_ids(
        train=[f"{k}" for k in range(6)], test=[f"{k}" for k in range(6, 12)], rule={}, manifest="m"
    ).save(Path("split.json"))
    encoders = EncoderSet.load("palpate/mini")
    encoders.save(Path("encoders"))
    pp.probe("real", "split.json", encoder="encoders").save("probe.json")
    pp.score("real", "real", encoder="encoders", companions=["fid"]).save("score.json")
    assert verify("probe.json").ok
    assert verify("score.json").ok
    with torch.no_grad():
        for weights in encoders.tactile.parameters():
            weights.mul_(1.1)
    shutil.rmtree("encoders")
    encoders.save(Path("encoders"))
    for file in ("probe.json", "score.json"):
        changed = differing(file)
        assert f"call {file.removesuffix('.json')}" in changed
        assert len(changed) > 1
