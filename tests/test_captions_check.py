"""The check of captions: every planted fault is counted; names of materials are left out."""

import json

import numpy as np
import polars as pl
import pytest

from palpate.captions import caption, check_captions
from palpate.captions.vocabulary import Vocabulary, visual_in
from palpate.cli import main
from palpate.core import PalpateError, Split
from palpate.data.manifest import Manifest

MATERIALS = ("Wood", "Natural Fabric", "Others", "Slate tile")


@pytest.fixture
def samples(tmp_path):
    """A function: texts by number of a contact -> 40 contacts of 20 videos and 4 materials."""

    def make(text_of):
        rows = [
            {
                "id": f"v{k // 2}/{k}{frame}",
                "video": f"v{k // 2}",
                "contact": f"c{k}",
                "material": MATERIALS[k // 2 % 4],
                "text": text_of(k),
            }
            for k in range(40)
            for frame in range(2)
        ]
        return Manifest.from_rows(rows, tmp_path)

    return make


def shares(results):
    return {s.a: s.value for s in results["share of captions"]}


@pytest.mark.parametrize(
    ("label", "text", "names"),
    [
        ("Wood", "a wooden, woody plank of woods", ["wooden", "woody", "plank", "woods"]),
        ("Wood", "hollow, wobbly and good", []),
        ("Metal", "Metallic, metals", ["metallic", "metals"]),
        ("Natural Fabric", "natural, fabric-like", ["fabric"]),
        ("Plants", "leafy leaves of a plant", ["leafy", "leaves", "plant"]),
        ("Slate tile", "tiles on slate, ceramic", ["tiles", "slate", "ceramic"]),
        ("Zebra wool 2", "zebras", ["zebras"]),
        ("Others", "other surface of natural material", []),
        ("Rubber", "rubbery tires", ["rubbery", "tires"]),
        ("Carpet", "rugged", []),
        ("Carpet", "carpeted, carpeting, a rug", ["carpeted", "carpeting", "rug"]),
        ("Tile", "tiled, tiling", ["tiled", "tiling"]),
        ("Plastic", "plasticky, plasticized", ["plasticky", "plasticized"]),
        ("Rubber", "rubberized, rubberlike; tired", ["rubberized", "rubberlike"]),
        ("Natural Fabric", "woolly, velvety, silken", ["woolly", "velvety", "silken"]),
        ("Metal", "metallised, tiny", ["metallised"]),
        ("Fur", "furry, further", ["furry"]),
        ("Soil", "oily, soiled, muddy", ["muddy"]),
        ("Plants", "leaving", []),
    ],
)
def test_inflections_and_synonyms_of_a_label(label, text, names):
    assert Vocabulary([label]).naming(text, label) == names


def test_names_of_other_materials_count_as_naming_a_material():
    assert Vocabulary(["Wood"]).naming("smooth granite", "Wood") == []
    assert Vocabulary(["Wood"]).naming("smooth granite, asphalt") == ["granite", "asphalt"]


def test_words_that_no_finger_feels():
    assert visual_in("Red, glossy, rectangular, round and smooth") == [
        "red",
        "glossy",
        "rectangular",
    ]


@pytest.mark.parametrize(
    ("text", "masked"),
    [
        ("fabric, coarse, deformable", "coarse, deformable"),
        ("rough, bumpy surface typical of concrete", "rough, bumpy surface typical of material"),
        ("Rugged tree bark.", "Rugged material."),
        ("wood", ""),
        ("smooth, hard", "smooth, hard"),
        ("a wooden plank, sawn", "sawn"),
    ],
)
def test_masked(text, masked):
    assert Vocabulary().masked(text) == masked


PLANTED = {
    "naming their label": "a {name} plank",
    "visual words": "red and soft",
    "digits": "rough 42",
    "refusals": "I'm sorry, I can't see the image",
    "empty": "  ",
    "over 40 words": "soft " * 41,
}


@pytest.mark.parametrize("kind", PLANTED)
def test_planted_faults_are_counted(samples, kind):
    def text_of(k):
        name = "wooden" if MATERIALS[k // 2 % 4] == "Wood" else "fabric"
        return PLANTED[kind].format(name=name) if k % 8 == 0 else f"rough, {'abcdef'[k % 6]}"

    results = check_captions(samples(text_of))
    assert shares(results)[kind] == shares(results)["flagged"] == 5 / 40
    others = set(PLANTED) - {kind}
    assert all(shares(results)[name] == 0 for name in others)
    assert results["share of captions", kind].interval is not None
    assert sum(results["share of captions", kind].details["words"].values()) >= 5


def test_one_text_for_many_contacts(samples):
    results = check_captions(samples(lambda k: "rough and hard" if k < 10 else f"soft {'x' * k}"))
    score = results["share of captions", "the commonest text"]
    assert score.value == 10 / 40
    assert [note.code for note in score.notes] == ["captions-common"]


def test_texts_that_train_and_test_share(samples):
    manifest = samples(lambda k: f"word{'x' * (k % 30)}")
    parts = {"train": manifest.ids[:60], "test": manifest.ids[60:]}
    results = check_captions(manifest, split=Split.from_ids(**parts))
    score = results["share of captions", "test captions that train has"]
    assert (score.value, score.n) == (1.0, 10)
    with pytest.raises(PalpateError, match="captions in train and test"):
        check_captions(manifest, split=Split.from_ids(train=manifest.ids))
    with pytest.raises(PalpateError, match=r"split must hold ids .* 'x', 'y' instead of 'v0/00'"):
        check_captions(manifest, split=Split.from_ids(train=["x"], test=["y"]))


def accuracies(results):
    return {s.a: s.value for s in results["material accuracy from the text"]}


def test_codes_of_the_label_are_recognized_on_new_videos(samples):
    codes = check_captions(samples(lambda k: f"feels {'abcd'[k // 2 % 4] * 3}ish"))
    assert accuracies(codes)["text"] == accuracies(codes)["text without names of materials"] == 1
    note = codes["material accuracy from the text", "text"].notes[0]
    assert note.code == "captions-code"


def test_names_alone_give_the_material_away_until_they_are_masked(samples):
    nouns = ("wooden", "fabric", "spongy", "tile")
    rng = np.random.default_rng(0)
    words = [rng.choice(["rough", "hard", "soft"], 2) for _ in range(40)]
    results = check_captions(samples(lambda k: f"{nouns[k // 2 % 4]}, {', '.join(words[k])}"))
    assert accuracies(results)["text"] == 1
    assert accuracies(results)["text without names of materials"] < 0.6
    assert accuracies(results)["commonest material"] <= 0.3


def test_random_words_predict_nothing(samples):
    rng = np.random.default_rng(1)
    words = ["rough", "hard", "soft", "dry", "slick", "firm"]
    results = check_captions(samples(lambda k: ", ".join(rng.permutation(words)[:3])))
    assert accuracies(results)["text"] < 0.55


def test_without_materials_or_videos(samples):
    manifest = samples(lambda k: "rough")
    table = manifest.table.with_columns(material=pl.lit(None, pl.String))
    results = check_captions(Manifest(table, manifest.root))
    assert [note.code for note in results.notes] == ["captions-no-labels"]
    few = Manifest(manifest.table.head(8), manifest.root)
    assert [note.code for note in check_captions(few).notes] == ["captions-few"]


def test_captions_and_samples_in_two_places(samples, tmp_path):
    manifest = samples(lambda k: None)
    manifest.save(tmp_path / "tag" / "manifest.parquet")
    caption(manifest, tmp_path / "c", template="{material} plate")
    page, output = tmp_path / "p.html", tmp_path / "check.json"
    args = ["caption", "check", tmp_path / "c", "--data", tmp_path / "tag", "-q"]
    more = ["--page", page, "-o", output, "--fail-over", "0.1"]
    assert main([*map(str, [*args, *more])]) == 1
    assert "naming their label" in page.read_text(encoding="utf-8")
    assert json.loads(output.read_text())["format"] == "palpate-results/1"
    assert main([*map(str, args), "--fail-over", "0.9"]) == 0


@pytest.mark.parametrize(
    ("make", "got"),
    [
        (lambda folder, m: check_captions(m), "without any text"),
        (lambda folder, m: check_captions(folder / "none", m), "no file"),
        (lambda folder, m: check_captions(folder / "other.csv", m), "'x/1' instead of 'v0/00'"),
        (lambda folder, m: check_captions([{"id": "1"}], m), "a folder or a table"),
    ],
)
def test_what_cannot_be_checked(samples, tmp_path, make, got):
    (tmp_path / "other.csv").write_text("id,text\nx/1,rough\n")
    with pytest.raises(PalpateError, match=got):
        make(tmp_path, samples(lambda k: None))


def test_captions_of_tvl(real_data, capsys):
    path = real_data / "tvl" / "test_items.json"
    args = ["caption", "check", path, "--map", "text=label", "id=tactile_fp", "--json", "-q"]
    assert main([*map(str, args)]) == 0
    scores = {s["a"]: s for s in json.loads(capsys.readouterr().out)["scores"]}
    assert {s["n"] for s in scores.values()} == {402}
    assert scores["naming a material"]["value"] == pytest.approx(73 / 402)
    assert scores["visual words"]["value"] == pytest.approx(103 / 402)
    assert scores["visual words"]["details"]["words"]["glossy"] == 52
