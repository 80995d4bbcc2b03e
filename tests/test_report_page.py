"""The page as a file: well-formed, self-contained, escaped, within its size, honest about gaps."""

import base64
import hashlib
import io
import json
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from forge.errors import fails
from forge.results import (
    Tree,
    difference,
    full_audit,
    full_results,
    gallery,
    images,
    pretraining_audit,
    score,
    small_audit,
    text_note,
)
from palpate.core import PalpateError, SampleRef
from palpate.report import summary_lines, write_report
from palpate.report.page import in_turns
from palpate.report.plots import (
    MAX_BARS,
    axis_over,
    bar,
    bins_of,
    gap_histogram,
    nice_step,
    score_histogram,
)
from palpate.report.records import Claim, GalleryItem, LeakPair, Signal, StudyTable
from palpate.report.results import Results

NASTY = "<script>alert(1)</script> & \"q\" 'q' 100% $x_1$ \\input{a} | `c` [d]"


def page_of(results, folder, **options):
    return write_report(results, folder / "page.html", **options).page.read_text(encoding="utf-8")


def test_near_duplicates_show_what_chance_explains(tmp_path):
    chance = {"verdict": "no leak found", "expected": 1.0, "measured": 0.012, "counts": False}
    calibrated = Signal("near-duplicate tactile", 100, 3, 0.4, 0.01, **chance)
    untold = Signal("near-duplicate vision", 100, 0, 1.0, 0.01, verdict="cannot tell")
    audit = small_audit(signals=[calibrated, untold])
    texts = str(audit), Tree(page_of(Results("T", audits=[audit]), tmp_path)).text
    texts = *texts, Results("T", audits=[audit]).to_markdown()
    for text in texts:
        text = text.replace("\u00a0", " ").replace("\\", "")
        rates = "(1.000 expected by chance; promised rate 1.0 %, measured 1.2 %)"
        assert f"no more than chance explains {rates}" in text
        assert "cannot tell" in text


def test_pairs_without_photos_show_the_contact_and_no_empty_boxes(tmp_path):
    """A disc of three gray levels on a strong gradient: invisible as it is, plain as a contact."""
    y, x = np.mgrid[:64, :64]
    gel = np.stack([60 + 2 * x, 160 - y, 80 + y], -1).astype(np.uint8)
    disc = np.hypot(y - 40, x - 20) < 9
    for name, image in (("gel", gel), ("a", gel + 3 * disc[..., None].astype(np.uint8))):
        Image.fromarray(image).save(tmp_path / f"{name}.png")

    def pair(vision=None, background=None):
        refs = [SampleRef(k, vision=vision, tactile="a.png", background=background) for k in "tr"]
        return LeakPair(*refs, None, 0.9)

    both = small_audit([pair(background="gel.png"), pair()])
    html = page_of(Results("T", audits=[both]), tmp_path)
    assert 'class="lost"' not in html
    assert "Contact: the tactile image minus its background" in Tree(html).text
    alts = [a["alt"] for a in Tree(html).all("img")]
    assert alts == 2 * [
        f"{s} {k}: {s[0].lower() if s == 'Test' else 'r'}"
        for k in ("tactile image", "contact")
        for s in ("Test", "Train")
    ]
    tactile, _, contact, _, _, _, alone, _ = (im.astype(float) for im in shown_images(html))
    for image, clear in ((tactile, False), (contact, True), (alone, True)):
        inside, around = image[disc].mean(), image[~disc & (np.hypot(y - 40, x - 20) < 13)].mean()
        assert (inside - around > 30) == clear
    # A generated contact is amplified as the real one is: half of it shows as half.
    Image.fromarray(gel + 6 * disc[..., None].astype(np.uint8)).save(tmp_path / "real.png")
    sample = SampleRef("s", tactile="real.png", background="gel.png")
    html = page_of(Results("T", gallery=[GalleryItem(sample, "a.png")]), tmp_path)
    real, made = (im.astype(float)[disc].mean() - 128 for im in shown_images(html)[2:4])
    assert made == pytest.approx(real / 2, rel=0.2)
    photos = page_of(Results("T", audits=[small_audit([pair(vision="gel.png")])]), tmp_path)
    assert [a["alt"].split(":")[0] for a in Tree(photos).all("img")][::2] == [
        "Test photo",
        "Test tactile image",
    ]
    none = LeakPair(SampleRef("t", video="v"), SampleRef("r", video="v"), 3)
    bare = page_of(Results("T", audits=[small_audit([none])]), tmp_path)
    assert ('class="lost"' in bare, 'class="shots' in bare) == (False, False)


def shown_images(html):
    data = (a["src"].partition(",")[2] for a in Tree(html).all("img"))
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(d)))) for d in data]


def test_a_page_is_well_formed_self_contained_and_complete(tmp_path):
    results = full_results(tmp_path)
    write_report(results, tmp_path / "new" / "page.html", base=tmp_path)  # images of another folder
    other = (tmp_path / "new" / "page.html").read_text(encoding="utf-8")
    assert 'class="lost"' not in other
    html = page_of(results, tmp_path)
    places = re.findall(r"""(?:src|href|srcset|action)\s*=\s*["']?([^"'\s>]*)""", html)
    places += re.findall(r"url\(\s*[\"']?([^\"')]*)", html)
    assert len(places) > 20
    assert [p for p in places if not p.startswith(("data:", "#"))] == []
    assert "@import" not in html
    assert "default-src 'none'" in html
    (script,) = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in html  # of the very text that stands there
    tree = Tree(html)
    for text in (
        "A title",
        "80.0 % leak.",
        "Synthetic data.",
        "1.37",
        "[1.01, 1.75]",
        "real images (floor) 0.04",
        "null −0.05 to 0.06",
        "undefined",
        "one image for all",
        "A remark.",
        "palpate audit x",
        "median 24",
        "n = 240",
        "976 more in the JSON",
    ):
        assert text in tree.text, text
    ids = [a["id"] for _, a in tree.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert all(a["href"][1:] in ids for a in tree.all("a"))
    labels = [i for _, a in tree.tags if (i := a.get("aria-labelledby"))]
    assert labels
    assert set(labels) <= set(ids)
    assert all(a.get("alt") for a in tree.all("img"))
    assert len(tree.all("img")) == 6 * 3 + 4
    assert len(tree.all("script")) == 1
    assert page_of(full_results(tmp_path), tmp_path) == html  # the same twice
    scores = [score(subject="a"), score(subject="b"), difference("a", "b", better="a")]
    text = Tree(page_of(Results("T", scores=scores), tmp_path)).text
    assert "TMMD ↓ a b −1.00 [−1.50, −0.50] 97.5 % 0.05" in text
    assert "1.37 best † [1.01, 1.75]" in text.replace("best†", "best †")


def test_a_page_shows_every_part_of_an_audit(tmp_path):
    names = images(tmp_path, 8, 16)
    html = page_of(Results("T", audits=[full_audit(names), pretraining_audit()]), tmp_path)
    text = Tree(html).text
    for part in (
        "29,611 of 29,879 test samples leak (99.10 %).",
        "Its photo can hardly be distinguished from a photo of train.",
        "sensor drift 88 (no leak)",
        "Calibrated on 12,000 pairs of different videos.",
        "it costs 33.2 points",
        "33.2 [26.2, 40.1]",
        "near-duplicate vision: 8 pairs",
        "And 66 more groups.",
        "20220607_130000",
        "2 more pairs",
        "palpate split data/manifest.parquet",
        "Test against the pretraining data",
    ):
        assert part in text, part


def test_text_is_escaped_everywhere(tmp_path):
    sample, note = SampleRef(NASTY, NASTY, 3, NASTY, f"{NASTY}.png", None), text_note(NASTY)
    pair = LeakPair(sample, sample, None, 0.5, NASTY)
    row = {"group": NASTY, "train": 1, "val": 0, "test": 1, "leaking": 1}
    audit = full_audit(
        name=NASTY,
        group=NASTY,
        notes=[note],
        split=NASTY,
        matrix=[row],
        commands=[NASTY],
        signals=[Signal(NASTY, 1, 1, 1.0, notes=[note], worst=[pair], causes={NASTY: 1})],
    )
    details = {NASTY: NASTY, "matrix": [[1]], "classes": [NASTY]}
    nasty = score(NASTY, NASTY, notes=(note,), settings={NASTY: NASTY}, details=details)
    item = GalleryItem(sample, f"{NASTY}.png", NASTY)
    settings = {NASTY: {NASTY: [NASTY]}}
    table = StudyTable(NASTY, NASTY, [NASTY, NASTY], [[NASTY, nasty], [NASTY, None]], True, [NASTY])
    results = Results(NASTY, [f"9 {NASTY}"], [audit], [nasty], [item], settings, [note], [NASTY])
    claims = [Claim(NASTY, NASTY, "holds", NASTY, [nasty])]
    results = replace(results, tables=[table], claims=claims)
    html = page_of(results, tmp_path)
    tree = Tree(html)
    assert html.count("<script") == 1
    assert tree.text.count(" ".join(NASTY.split())) > 30
    assert all(re.fullmatch(r"[a-z-]+[12]?|viewBox", k) for _, attrs in tree.tags for k in attrs)
    code = r"```.*?```|(?<![`\\])(`+)(?!`).*?(?<!`)\1(?!`)"
    markdown = re.sub(code, "", results.to_markdown(), flags=re.S)
    assert not re.search(r"(?<!\\)<", markdown)
    latex = "\n".join(li for li in results.to_latex().splitlines() if not li.startswith("%"))
    assert not re.search(r"\\input|\$x_1\$", latex)
    assert str(results).count(NASTY[:20]) > 5
    drawn = {"svg", "title", "desc", "style", "rect", "path", "text", "line", "circle"}
    for path in results.save_figures(tmp_path / "f"):
        assert path.parent.name == "f"
        if path.suffix == ".svg":
            assert {tag.tag.rpartition("}")[2] for tag in ET.parse(path).iter()} <= drawn


def test_missing_and_broken_images_become_placeholders(tmp_path):
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\nnot an image")
    (good,) = images(tmp_path, 1)
    lost = SampleRef("a", vision="absent&.png", tactile="broken.png")
    items = [GalleryItem(lost, good), GalleryItem(SampleRef("b"), good)]
    tree = Tree(page_of(Results("t", gallery=items), tmp_path))
    assert "no such file absent&.png" in tree.text
    assert re.search(r"not an image that can be read \(.*\) broken\.png", tree.text)
    assert tree.text.count("not recorded") == 2
    assert "2 images could not be read" in tree.text
    assert len(tree.all("img")) == 2


def test_small_images_stay_lossless_and_others_become_8_bit_on_white(tmp_path):
    (small,) = images(tmp_path, 1, 64)
    ramp = np.linspace(0, 60000, 128 * 128).reshape(128, 128).astype(np.uint16)
    Image.fromarray(ramp).save(tmp_path / "deep.png")
    Image.new("RGBA", (40, 40), (255, 0, 0, 0)).save(tmp_path / "clear.png")
    item = GalleryItem(SampleRef("a", vision=small, tactile="deep.png"), "clear.png")
    html = page_of(Results("t", gallery=[item]), tmp_path)
    exact, deep, clear = shown_images(html)
    assert np.array_equal(exact, np.asarray(Image.open(tmp_path / small)))
    assert Tree(html).all("img")[0]["class"] == "px"
    assert (deep.min(), deep.max()) == (0, round(60000 / 257))
    assert (clear == 255).all()


def test_a_page_keeps_within_its_size(tmp_path):
    results = Results("t", gallery=gallery(tmp_path, 50, side=256))
    opened = Results("t", gallery=results.gallery[:11])
    whole = page_of(opened, tmp_path)
    assert "11 of 11 chosen samples, 3 of them above" in Tree(whole).text
    size = len(whole.encode())
    shrunk = page_of(opened, tmp_path, max_bytes=size * 7 // 10)
    assert len(shrunk.encode()) <= size * 7 // 10
    assert len(Tree(shrunk).all("img")) == 33
    cut = page_of(results, tmp_path, max_bytes=60_000)
    tree = Tree(cut)
    rows = len(tree.all("img")) // 3
    assert len(cut.encode()) <= 60_000
    assert 0 < rows < 50
    assert re.search(rf"{rows} of 50 chosen samples, \d of them above, every material", tree.text)
    assert f"{50 - rows} rows of images were skipped" in tree.text
    assert len(json.loads((tmp_path / "page.json").read_text())["gallery"]) == 50
    audits = [full_audit(images(tmp_path, 16, 128))]  # lists of pairs take turns
    tree = Tree(page_of(Results("t", audits=audits), tmp_path, max_bytes=110_000))
    assert len(tree.all("figure")) > 0
    assert "rows of images were skipped" in tree.text
    fails("`max_bytes` must hold at least the text", page_of, results, tmp_path, max_bytes=2_000)


def test_the_gallery_is_folded_and_every_material_shows(tmp_path):
    materials = [f"m{k:02}" for k in range(30)]
    (name,) = images(tmp_path, 1, 8)
    refs = [SampleRef(f"{m}/{k}", m, k, m, name, name) for m in materials for k in range(10)]
    items = [GalleryItem(ref, name) for ref in refs]
    assert [i.sample.material for i in in_turns(items)[:30]] == materials
    before, _, after = page_of(Results("t", gallery=items), tmp_path).partition("149 more samples")
    assert (before.count("<img "), after.count("<img ")) == ((3 + 8) * 3, 149 * 3)
    captions = [f"{m} · <code>" for m in materials]
    assert [c in before for c in captions] == [True] * 11 + [False] * 19
    assert all(c in before + after for c in captions)


def test_empty_sections_name_the_command_that_fills_them(tmp_path):
    with pytest.raises(PalpateError, match="must agree in bandwidth"):
        page_of(Results("t", scores=[score(), score(subject="b", bandwidth=1.0)]), tmp_path)
    fails(r"must end in \.html", write_report, Results("t"), tmp_path / "page.json")
    assert list(tmp_path.iterdir()) == []  # what cannot be drawn writes nothing
    settings = {"rate": float("nan"), "path": tmp_path, "array": np.arange(3), "x": np.float32(0.5)}
    tree = Tree(page_of(Results("Nothing yet", settings=settings), tmp_path))
    written = json.loads((tmp_path / "page.json").read_text())["settings"]
    assert written == {"rate": None, "path": str(tmp_path), "array": [0, 1, 2], "x": 0.5}
    for text in ("palpate generate", "palpate score", "palpate audit", "nothing has been measured"):
        assert text in tree.text
    empty = dict.fromkeys(("gap_min", "gap_median", "gap_max"))
    empty |= dict.fromkeys(("gap_edges", "gap_counts"), ())
    bare = small_audit(**empty, materials=(), test_samples=0, leaked_fraction=0.0)
    html = page_of(Results("t", audits=[bare]), tmp_path)
    assert "the test part is empty" in Tree(html).text
    assert "histogram" not in html.partition("<body>")[2]


def test_headline_facts():
    facts = ["one", "two", "three"]
    assert summary_lines(Results("t", facts=[*facts, "four"])) == facts
    clean = {"signals": [Signal("shared video", 100, 0, 1.0)], "leaking_samples": 0}
    audits = [small_audit(), small_audit(name="NoLeak", **clean)]
    scores = [score(value=None, interval=None), score(subject="GVST")]
    assert summary_lines(Results("t", audits=audits, scores=scores)) == [
        "Orig: leaks. 80.0 % of the test samples share a video with train. 80 of 100 test samples "
        "leak (80.0 %).",
        "NoLeak: no leak found. None of 100 test samples leaks by the one signal checked.",
        "TMMD (lower is better): GVST 1.37 [1.01, 1.75]; floor 0.04.",
    ]
    assert summary_lines(Results("t")) == []


@pytest.mark.parametrize(
    ("values", "inside"),
    [([1.0, 4.0], 0.0), ([3.0, 4.0], 3.0), ([-4.0, -1.0], 0.0), ([2.0], 2.0), ([0.0], 0.0)],
)
def test_an_axis_holds_its_values_and_a_zero_nearby(values, inside):
    for (span, parts), step in {(1, 3): 0.5, (10, 3): 5, (0.07, 3): 0.05, (31, 3): 20}.items():
        assert nice_step(span, parts) == pytest.approx(step)
    axis = axis_over(values)
    assert axis.low <= min([*values, inside])
    assert axis.high >= max([*values, inside])
    assert axis_over([None, float("inf")]) is None


def rects(svg, kind):
    return [e for e in ET.fromstring(str(svg)).iter("rect") if e.get("class") == kind]


def test_bars_and_histograms_draw_their_numbers_and_join_fine_bins():
    axis = axis_over([0.0, 10.0])
    tree = ET.fromstring(str(bar(axis, 5.0, (0.0, 10.0), (2.0, 4.0), 1.0)))
    assert {e.tag: e.get("class") for e in tree}["circle"] == "value"
    assert float(tree.find("circle").get("cx")) == pytest.approx(axis.x(5.0))
    assert bar(None, 1.0, None) == ""
    svg = gap_histogram(full_audit())
    heights = [float(e.get("height")) for e in rects(svg, "column")]
    assert (len(heights), max(heights)) == (8, pytest.approx(70))  # bins that are not empty
    assert "median 304" in svg
    for counts in ([0, 0, 0], [0, 7, 0]):  # nothing, or one bar
        assert gap_histogram(small_audit(gap_counts=counts)) == ""
    signal = full_audit().signals[-1]
    _, unrelated, matches = bins_of(signal)
    assert len(matches) <= MAX_BARS
    assert (sum(unrelated), sum(matches)) == (sum(signal.unrelated), sum(signal.matches))
    svg = score_histogram(signal, "in words")
    assert len(rects(svg, "apart")) == sum(map(bool, unrelated))
    assert len(rects(svg, "column")) + len(rects(svg, "below")) == sum(map(bool, matches))
    assert "flagged from 0.872" in svg
    assert score_histogram(Signal("time gap", 1, 1, 0.5), "") == ""
