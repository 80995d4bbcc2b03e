"""The page as a file: well-formed, self-contained, escaped, within its size, and honest about what is missing."""

import base64
import dataclasses
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from palpate.core import Note, PalpateError, SampleRef, Score
from palpate.report import summary_lines, write_report
from palpate.report.page import in_turns
from palpate.report.results import Audit, GalleryItem, LeakPair, Results

VOID = {"meta", "link", "img", "line", "rect", "path", "circle", "br", "hr"}
NASTY = "<script>alert(\"x\")</script> & 'quotes'"


class Tree(HTMLParser):
    """Checks nesting and collects tags with attributes and the text of each id-bearing section."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.words = [], [], []
        self.feed(text)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def picture(path, side=64, seed=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(
        np.random.default_rng(seed).integers(0, 256, (side, side, 3), dtype=np.uint8)
    ).save(path)
    return path.name


def items(folder, n, side=64, materials=("wood", "rock", "grass")):
    out = []
    for k in range(n):
        names = [
            picture(folder / f"{kind}{k}.png", side, 3 * k + j)
            for j, kind in enumerate(("v", "t", "g"))
        ]
        sample = SampleRef(
            f"vid{k % 4}/{k}", f"vid{k % 4}", k, materials[k % len(materials)], names[0], names[1]
        )
        out.append(GalleryItem(sample, names[2]))
    return out


def an_audit(worst=(), **changes):
    audit = Audit(
        "Orig",
        "video",
        900,
        100,
        10,
        5,
        4,
        80,
        0.8,
        3,
        1,
        24.0,
        60,
        [0, 10, 30, 60],
        [10, 40, 30],
        worst,
        [{"material": "wood", "train": 500, "test": 60, "groups_train": 6, "groups_test": 3}],
        [Note("text", {"text": "A remark."})],
        "ab" * 32,
    )
    return dataclasses.replace(audit, **changes)


def a_score(**changes):
    base = Score(
        "TMMD",
        "generated",
        1.374,
        (1.01, 1.75),
        0.95,
        "jackknife, t, 9 df",
        (-0.05, 0.06),
        0.042,
        "unbiased",
        10.0,
        1000.0,
        240,
    )
    return dataclasses.replace(base, **changes)


def full(folder, n=6, side=64):
    gallery = items(folder, n, side)
    pair = LeakPair(gallery[0].sample, gallery[1].sample, 7)
    matrix = {"matrix": [[0.1, 3.0], [3.0, 0.25]], "classes": ["wood", "rock"]}
    scores = [
        a_score(),
        a_score(
            subject="background",
            value=None,
            interval=None,
            note="Undefined: one picture for all classes",
        ),
        a_score(metric="D-TMMD", value=0.44, interval=None, null=None, floor=None, details=matrix),
        a_score(
            metric="SSIM",
            value=0.49,
            interval=(0.47, 0.51),
            higher_is_better=True,
            null=None,
            floor=None,
            note="Of pairs alone.",
        ),
    ]
    settings = {
        "split": {"digest": "cd" * 32, "seed": 0},
        "many": list(range(1000)),
        "nothing": None,
        "classes": {"oak": {"n": 3, "E": 0.5}, "elm": {"n": 4, "E": 0.25}},
    }
    return Results(
        "A title",
        ["80.0 % leak."],
        [an_audit([pair])],
        scores,
        gallery,
        settings,
        [Note("text", {"text": "Synthetic data."})],
        ["palpate audit x"],
    )


def written(results, folder, **options):
    files = write_report(results, folder / "page.html", **options)
    return files, files.page.read_text(encoding="utf-8")


def test_page_is_well_formed_and_complete(tmp_path):
    _, html = written(full(tmp_path), tmp_path)
    tree = Tree(html)
    for said in (
        "A title",
        "80.0 % leak.",
        "Synthetic data.",
        "1.374",
        "[1.010, 1.750]",
        "floor 0.042",
        "null −0.050 to 0.060",
        "undefined",
        "one picture for all classes",
        "Of pairs alone.",
        "A remark.",
        "palpate audit x",
        "median 24",
        "n = 240",
        "976 more in the JSON",
        "n E oak 3 0.5 elm 4 0.25",
    ):
        assert said in tree.text, said
    assert "Undefined: one picture" not in tree.text
    ids = [a["id"] for _, a in tree.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert all(a["href"][1:] in ids for a in tree.all("a"))
    assert all(i in ids for _, a in tree.tags if (i := a.get("aria-labeledby")))
    assert all(a.get("alt") for a in tree.all("img"))
    assert len(tree.all("img")) == 6 * 3 + 4
    assert [a.get("aria-label") for a in tree.all("svg") if a.get("role") == "img"] == [
        "Histogram of gaps for Orig: 80 test samples, 0 to 60 frames, median 24"
    ]
    assert not tree.all("script")


def test_page_refers_to_nothing_outside(tmp_path):
    _, html = written(full(tmp_path), tmp_path)
    places = re.findall(
        r"""(?:src|href|srcset|poster|action)\s*=\s*["']?([^"'\s>]*)""", html
    ) + re.findall(r"url\(\s*[\"']?([^\"')]*)", html)
    assert len(places) > 20
    assert [p for p in places if not p.startswith(("data:", "#"))] == []
    assert "@import" not in html
    assert "default-src 'none'" in html


def test_text_is_escaped_everywhere(tmp_path):
    nasty = SampleRef(NASTY, NASTY, 3, NASTY, f"{NASTY}.png", None)
    audit = an_audit(
        [LeakPair(nasty, nasty, None)],
        name=NASTY,
        group=NASTY,
        notes=[NASTY],
        materials=[{"material": NASTY}],
        split=NASTY,
    )
    scores = [
        a_score(
            metric=NASTY,
            subject=NASTY,
            note=NASTY,
            estimator=NASTY,
            settings={NASTY: NASTY},
            details={NASTY: NASTY},
        ),
        a_score(metric="D", subject=NASTY, details={"matrix": [[1]], "labels": [NASTY]}),
    ]
    results = Results(
        NASTY,
        [f"9 {NASTY}"],
        [audit],
        scores,
        [GalleryItem(nasty, f"{NASTY}.png", NASTY)],
        {NASTY: {NASTY: [NASTY]}},
        [NASTY],
        [NASTY],
    )
    _, html = written(results, tmp_path)
    tree = Tree(html)
    assert not tree.all("script")
    assert "<script" not in html
    assert tree.text.count(" ".join(NASTY.split())) > 15
    allowed = {"aria-label", "aria-labeledby", "aria-hidden", "http-equiv", "color-scheme"}
    assert all(
        re.fullmatch(r"[a-z0-9-]+", name) or name in allowed
        for _, attrs in tree.tags
        for name in attrs
    )
    markdown = (tmp_path / "page.md").read_text()
    assert not re.search(r"(?<!\\)<", re.sub(r"```.*?```|`[^`]*`", "", markdown, flags=re.S))


def test_missing_and_broken_pictures_become_placeholders(tmp_path):
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nnot a picture")
    good = picture(tmp_path / "good.png")
    results = Results(
        "t",
        gallery=[
            GalleryItem(SampleRef("a", vision="absent&.png", tactile="broken.png"), good),
            GalleryItem(SampleRef("b"), good),
        ],
    )
    _, html = written(results, tmp_path)
    tree = Tree(html)
    assert "absent&.png" in tree.text
    assert "broken.png" in tree.text
    assert "file missing" in tree.text
    assert "file unreadable" in tree.text
    assert tree.text.count("not recorded") == 2
    assert "2 pictures could not be read" in tree.text
    assert len(tree.all("img")) == 2


def test_tiny_pictures_stay_lossless_and_unsmoothed(tmp_path):
    picture(tmp_path / "v.png", 64, 5)
    picture(tmp_path / "big.png", 300, 6)
    _, html = written(
        Results(
            "t", gallery=[GalleryItem(SampleRef("a", vision="v.png", tactile="big.png"), "v.png")]
        ),
        tmp_path,
    )
    tiny, big, _ = Tree(html).all("img")
    assert tiny["class"] == "px"
    assert (tiny["width"], big["width"]) == ("64", "256")
    assert "class" not in big
    data = base64.b64decode(tiny["src"].partition(",")[2])
    assert np.array_equal(
        np.asarray(Image.open(io.BytesIO(data))), np.asarray(Image.open(tmp_path / "v.png"))
    )


def test_sixteen_bit_and_transparent_pictures(tmp_path):
    ramp = np.linspace(0, 60000, 64 * 64).reshape(64, 64).astype(np.uint16)
    Image.fromarray(ramp).save(tmp_path / "deep.png")
    Image.new("RGBA", (40, 40), (255, 0, 0, 0)).save(tmp_path / "clear.png")
    _, html = written(
        Results("t", gallery=[GalleryItem(SampleRef("a", vision="deep.png"), "clear.png")]),
        tmp_path,
    )
    shown = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(a["src"].partition(",")[2]))))
        for a in Tree(html).all("img")
    ]
    assert (shown[0].min(), shown[0].max()) == (0, 255)
    assert (shown[1] == 255).all()


def test_page_keeps_within_its_size(tmp_path):
    results = Results("t", gallery=items(tmp_path, 50, side=256))
    files, generous = written(results, tmp_path)
    full_size = files.page.stat().st_size
    assert full_size <= 10_000_000
    assert "of pictures were left out" not in generous
    files, shrunk = written(results, tmp_path, max_bytes=full_size * 7 // 10)
    assert files.page.stat().st_size <= full_size * 7 // 10
    assert len(Tree(shrunk).all("img")) == 150
    files, cut = written(results, tmp_path, max_bytes=60_000)
    assert files.page.stat().st_size <= 60_000
    tree = Tree(cut)
    left = len(tree.all("img")) // 3
    assert 0 < left < 50
    assert f"{left} of 50 rows are on this page" in tree.text
    assert f"{50 - left} rows of pictures were left out" in tree.text
    assert len(json.loads(files.json.read_text())["gallery"]) == 50
    with pytest.raises(PalpateError, match="largest size must hold at least its text"):
        written(results, tmp_path, max_bytes=2_000)


def test_gallery_is_folded_and_every_material_shows(tmp_path):
    materials = [f"m{k:02}" for k in range(30)]
    name = picture(tmp_path / "p.png", 8)
    many = [
        GalleryItem(SampleRef(f"{m}/{k}", m, k, m, name, name), name)
        for m in materials
        for k in range(10)
    ]
    assert [i.sample.material for i in in_turns(many)[:30]] == materials
    _, html = written(Results("t", gallery=many), tmp_path)
    before, _, after = html.partition("<summary>More of the gallery")
    assert before.count("<img ") == 40 * 3
    assert after.count("<img ") == 120 * 3
    assert all(f"<h3>{m}</h3>" in before for m in materials)
    assert "160 of 300 rows are on this page" in Tree(html).text


def test_empty_sections_say_what_would_fill_them(tmp_path):
    _, html = written(Results("Nothing yet"), tmp_path)
    tree = Tree(html)
    for command in ("palpate generate", "palpate score", "palpate audit"):
        assert command in tree.text
    assert "nothing has been measured yet" in tree.text
    bare = an_audit(
        gap_min=None,
        gap_median=None,
        gap_max=None,
        gap_edges=(),
        gap_counts=(),
        materials=(),
        test_samples=0,
        leaked_fraction=0.0,
    )
    Tree(written(Results("t", audits=[bare]), tmp_path)[1])


def test_scores_of_different_settings_are_refused_and_nothing_is_written(tmp_path):
    results = Results("t", scores=[a_score(), a_score(subject="other", bandwidth=1.0)])
    with pytest.raises(PalpateError, match="must agree in bandwidth"):
        write_report(results, tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_page_name_must_end_in_html(tmp_path):
    with pytest.raises(PalpateError, match=r"must end in \.html"):
        write_report(Results("t"), tmp_path / "page.json")


def test_json_round_trip(tmp_path):
    results = full(tmp_path)
    files, _ = written(results, tmp_path)
    again = Results.load(files.json)
    assert again.to_json() == results.to_json()
    assert again.scores == results.scores
    assert again.gallery == results.gallery


def test_json_holds_what_json_cannot(tmp_path):
    settings = {
        "rate": float("nan"),
        "path": tmp_path,
        "array": np.arange(3),
        "one": np.float32(0.5),
    }
    files, _ = written(Results("t", settings=settings), tmp_path)
    assert json.loads(files.json.read_text())["settings"] == {
        "rate": None,
        "path": tmp_path.as_posix(),
        "array": [0, 1, 2],
        "one": 0.5,
    }


def test_all_picture_paths_are_counted_from_the_page(tmp_path):
    name = picture(tmp_path / "data" / "a.png")
    absolute = str(tmp_path / "data" / "a.png")
    results = Results(
        "t", gallery=[GalleryItem(SampleRef("a", vision=name, tactile=absolute), name)]
    )
    files = write_report(results, tmp_path / "out" / "page.html", base=tmp_path / "data")
    assert len(Tree(files.page.read_text()).all("img")) == 3
    item = Results.load(files.json).gallery[0]
    assert (item.sample.vision, item.sample.tactile, item.generated) == (
        "../data/a.png",
        "../data/a.png",
        "../data/a.png",
    )
    assert (
        write_report(Results.load(files.json), files.page).page.read_text()
        == files.page.read_text()
    )


def test_page_is_the_same_twice(tmp_path):
    results = full(tmp_path)
    assert written(results, tmp_path)[1] == written(results, tmp_path)[1]


def test_summary_lines():
    said = ["one", "two", "three"]
    assert summary_lines(Results("t", facts=[*said, "four"])) == said
    clean = an_audit(
        name="NoLeak", groups_shared=0, test_samples_in_shared_groups=0, leaked_fraction=0.0
    )
    lines = summary_lines(
        Results(
            "t",
            audits=[an_audit(), clean],
            scores=[a_score(value=None, interval=None), a_score(subject="GVST")],
        )
    )
    assert lines == [
        "Orig: 80.0 % of the test samples leak; 80 of 100 come from a video that train holds as well.",
        "NoLeak: no video is shared; none of the 100 test samples leaks.",
        "TMMD (lower is better): GVST 1.374 [1.010, 1.750]; floor 0.042.",
    ]
    assert summary_lines(Results("t")) == []
