"""The audit section: signals, the two histograms and their line, pairs by signal, matrix, impact, and the same as text and JSON."""

import dataclasses
import json
import re
import xml.etree.ElementTree as ET
from collections import Counter

import numpy as np
import pytest
from PIL import Image

from audit_samples import (
    clean_audit,
    full_audit,
    impact,
    many_names,
    matrix,
    pairs,
    pictures,
    pretraining_audit,
    signals,
)
from palpate.core import PalpateError, SampleRef
from palpate.report import render_markdown, summary_lines, with_paths, write_report
from palpate.report.audits import impact_view, matrix_view, pair_facts, pair_lists, signal_view
from palpate.report.plots import BARS, bins_of, gap_histogram, score_histogram
from palpate.report.results import MATRIX_ROWS, ImpactRow, LeakPair, Results, Signal
from palpate.report.sentences import audit_line, leak_line, line_text, meaning_of
from palpate.report.text import score_text
from test_report_page import NASTY, Tree, an_audit, written


def svg(markup):
    return ET.fromstring(str(markup))


def share(element, name):
    return float(element.get(name).rstrip("%"))


def calibrated(**changes):
    base = Signal(
        "near-duplicate touch",
        100,
        30,
        0.75,
        0.01,
        (0.0, 0.25, 0.5, 0.75, 1.0),
        (10, 30, 8, 2),
        (5, 15, 50, 30),
        {"content": 30},
    )
    return dataclasses.replace(base, **changes)


def test_page_shows_every_part_of_an_audit(tmp_path):
    names = pictures(tmp_path, 8, 32)
    _, html = written(
        Results("T", audits=[full_audit(names), clean_audit(), pretraining_audit(names)]), tmp_path
    )
    tree = Tree(html)
    for said in (
        "29,611 of 29,879 test samples leak (99.10 %).",
        "shared video Its video is also in train",
        "15.6 % 4,610 of 29,597 looked at",
        "score 0.872",
        "0.10 %",
        "nothing touched 1,204 (no leak)",
        "sensor drift 88 (no leak)",
        "Where the line was drawn",
        "4,893 of 29,879 test samples (16.4 %) lie at or beyond it",
        "flagged from 0.872",
        "unrelated samples (12,000)",
        "test against train (29,879)",
        "score 0.964 · near-duplicate touch · sensor drift: no leak",
        "another video",
        "31 frames apart",
        "What the leak costs",
        "it costs 33.2 points [26.2, 40.1]",
        "71.4 [66.0, 76.5]",
        "linear probe",
        "And 66 more groups.",
        "20220607_130000 90 610 610",
        "What to do next",
        "palpate audit data/manifest.parquet --split noleak.json",
        "None of 24,000 test samples leaks by the 2 signals that were looked for.",
        "Test against the pretraining data pretrain.csv / test",
        "Pretraining: ssvtp_08_0842",
        "none could be looked at",
        "Its video is also in the pretraining data",
    ):
        assert said in tree.text, said
    drawn = [a["aria-label"] for a in tree.all("svg") if a.get("role") == "img"]
    assert len(drawn) == 3
    assert drawn[2].startswith(
        "Two histograms of scores of near-duplicate touch. The line stands at a score of 0.872, where 0.10 % of the"
    )
    assert "The middle half of the unrelated samples scores 0.5" in drawn[2]
    ids = [a["id"] for _, a in tree.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert all(a.get("alt") for a in tree.all("img"))
    assert not tree.all("script")
    assert re.findall(r'<p class="big[^"]*">([^<]+)</p>', html) == ["99.10 %", "0 %", "1.3 %"]
    assert (
        sum("open" in a for a in tree.all("details")) == 2
    )  # the strongest pairs of each audit that has some
    assert "Nearest pairs" not in tree.text  # the signal of the time gap shows them


def test_parts_that_an_audit_lacks_are_not_drawn(tmp_path):
    _, html = written(
        Results("T", audits=[an_audit([LeakPair(SampleRef("a"), SampleRef("b"), 7)])]), tmp_path
    )
    text = Tree(html).text
    assert "80 of 100 test samples in a video that train holds as well" in text
    assert "Nearest pairs" in text
    for said in (
        "What was looked for",
        "Where the line",
        "Worst pairs",
        "Groups by part",
        "costs",
        "What to do next",
        "can hardly be told",
    ):
        assert said not in text, said
    bare = Signal("shared video", 5, 0, 1.0)
    text = Tree(
        written(Results("T", audits=[an_audit(signals=[bare], test_samples=0)]), tmp_path)[1]
    ).text
    assert "the test part is empty" in text
    for said in ("False positives", "Alike because of", "Where the line"):
        assert said not in text, said


def test_two_histograms_stand_on_one_axis_with_the_threshold():
    signal = calibrated(threshold=0.8)
    root = svg(score_histogram(signal, "said"))
    assert root.get("aria-label") == "said"
    at = lambda v: 13 + 86 * v  # noqa: E731
    kinds = Counter(e.get("class") for e in root)
    assert (kinds["apart"], kinds["below"], kinds["column"]) == (4, 4, 1)
    line = next(e for e in root if e.get("class") == "median")
    assert share(line, "x1") == pytest.approx(at(0.8), abs=0.01)
    apart = [e for e in root if e.get("class") == "apart"]
    heights = np.array([float(e.get("height")) for e in apart])
    assert heights / heights[1] == pytest.approx(np.array([10, 30, 8, 2]) / 30, abs=0.02)
    strong = next(e for e in root if e.get("class") == "column")
    assert share(strong, "x") == pytest.approx(at(0.8), abs=0.01)
    assert share(strong, "x") + share(strong, "width") == pytest.approx(
        at(1.0) - 0.06 * (at(1.0) - at(0.75)), abs=0.01
    )
    assert strong[0].text == "0.750 to 1.000: 30"
    cut = [e for e in root if e.get("class") == "below"][-1]
    assert (share(cut, "x") + share(cut, "width"), cut.get("height")) == (
        pytest.approx(at(0.8), abs=0.01),
        strong.get("height"),
    )
    texts = [e.text for e in root if e.tag == "text"]
    assert {
        "flagged from 0.800",
        "unrelated samples (50)",
        "test against train (100)",
        "0.0",
        "0.4",
        "1.0",
    } <= set(texts)
    scale = [float(t.removesuffix("\u00a0%")) for t in texts if t.endswith("%")]
    assert float(apart[1].get("height")) == pytest.approx(70 * 60 / scale[0], abs=0.1)


def test_histograms_of_nothing_or_of_a_wrong_shape_are_not_drawn():
    wrong = (
        calibrated(edges=(), unrelated=(), matches=()),
        calibrated(matches=(1, 2)),
        calibrated(unrelated=(1,)),
        calibrated(edges=(0, 0.25, 0.25, 0.75, 1)),
        calibrated(unrelated=(0,) * 4, matches=(0,) * 4),
        calibrated(edges=(0, 1, 2, 3, float("nan"))),
        calibrated(threshold=float("nan")),
    )
    for signal in wrong:
        assert bins_of(signal) is None
        assert not score_histogram(signal, "")
        assert signal_view(signal, full_audit()).bins == []
    alone = svg(score_histogram(calibrated(unrelated=()), ""))
    assert not [e for e in alone if e.get("class") == "apart"]
    for threshold in (-1.0, 0.0, 1.0, 7.0):
        assert svg(score_histogram(calibrated(threshold=threshold), "")) is not None


@pytest.mark.parametrize("size", [1, 7, BARS, BARS + 1, 80, 1000])
def test_bins_are_joined_evenly_and_lose_nothing(size):
    rng = np.random.default_rng(size)
    edges = np.linspace(0, 1, size + 1)
    found = rng.integers(0, 5, size) * (edges[1:] > 0.3)
    found[-1] = 3
    unrelated = rng.integers(0, 5, size) * (edges[1:] > 0.2)
    bins = bins_of(
        calibrated(
            edges=edges.tolist(),
            matches=found.tolist(),
            unrelated=unrelated.tolist(),
            threshold=0.9,
        )
    )
    assert len(bins.matches) <= BARS
    assert (sum(bins.matches), sum(bins.unrelated)) == (found.sum(), unrelated.sum())
    assert bins.even
    again = [
        int(found[(edges[:-1] >= a - 1e-9) & (edges[1:] <= b + 1e-9)].sum())
        for a, b in zip(bins.edges, bins.edges[1:], strict=False)
    ]
    assert again == list(bins.matches)


def test_uneven_bins_are_drawn_by_area():
    signal = calibrated(
        edges=(0.0, 0.5, 0.6, 1.0), unrelated=(0, 0, 0), matches=(50, 10, 40), threshold=0.5
    )
    root = svg(score_histogram(signal, ""))
    heights = [float(e.get("height")) for e in root if e.get("class") in ("below", "column")]
    assert heights == pytest.approx([heights[0]] * 3, abs=0.11)  # 100 a unit of score in each
    assert not [e.text for e in root if e.tag == "text" and e.text.endswith("%")]


def test_gap_histogram_reaches_from_least_to_most():
    root = svg(gap_histogram(full_audit()))
    wide = (99 - 13) / 12
    ends = sorted(
        share(e, "x1") for e in root if e.get("class") == "reach" and e.get("x1") == e.get("x2")
    )
    assert ends == pytest.approx([13 + wide * (4 + 1 / 30), 13 + wide * (11 + 685 / 686)], abs=0.01)
    assert share(next(e for e in root if e.tag == "circle"), "cx") == pytest.approx(
        13 + wide * (8 + 4 / 300), abs=0.01
    )


def test_quantiles_of_a_histogram_match_the_samples():
    rng = np.random.default_rng(3)
    scores = rng.beta(4, 3, 40000)
    edges = np.linspace(0, 1, 41)
    counts = np.histogram(scores, edges)[0].tolist()
    view = signal_view(
        calibrated(edges=edges.tolist(), unrelated=counts, matches=counts), full_audit()
    )
    label = svg(view.histogram).get("aria-label")
    low, high = map(
        float, re.search(r"unrelated samples scores ([\d.]+) to ([\d.]+)\.", label).groups()
    )
    assert (low, high) == pytest.approx(np.quantile(scores, [0.25, 0.75]), abs=0.003)


def test_score_text_tells_a_score_from_one():
    assert [score_text(v) for v in (1.0, 0.5, 0.9995, 0.99999, 0.0, float("nan"))] == [
        "1.000",
        "0.500",
        "0.9995",
        "0.99999",
        "0.000",
        "–",
    ]


def test_sentences():
    audit = full_audit()
    assert audit_line(audit) == (
        "Orig: 99.06 % of the test samples share a video with train; 17.4 % have a near-duplicate photo in train; 15.6 % of the 29,597 looked "
        "at lie a moment from a frame of train. 29,611 of 29,879 test samples leak (99.10 %)."
    )
    assert (
        audit_line(clean_audit())
        == "NoLeak: none of 24,000 test samples leaks by the 2 signals that were looked for."
    )
    assert audit_line(pretraining_audit()) == (
        "pretrain.csv / test against the pretraining data: 1.3 % of the test samples have a picture that the pretraining data holds byte for "
        "byte. 310 of 24,000 test samples leak (1.3 %)."
    )
    assert (
        leak_line(clean_audit(test_samples=1, leaking_samples=1))
        == "1 of 1 test sample leaks (100 %)."
    )
    assert meaning_of(Signal("shared object", 1, 1, 1.0), audit).startswith(
        "Its object is also in train"
    )
    assert audit_line(
        clean_audit(name="N", signals=[Signal("odd kind", 24000, 240, 0.5)], leaking_samples=240)
    ) == (
        "N: 1.0 % of the test samples are flagged by odd kind. 240 of 24,000 test samples leak (1.0 %)."
    )
    assert "share an object with train" in audit_line(
        clean_audit(signals=[Signal("shared object", 24000, 9, 1.0)])
    )
    assert line_text(calibrated(causes={"content": 30, "sensor drift": 5})) == (
        "The line stands at a score of 0.750, where 1.0 % of the samples known to be unrelated find a match as good by chance. 35 of 100 test "
        "samples (35.0 %) lie at or beyond it."
    )
    assert summary_lines(Results("t", audits=[audit]))[1] == impact().headline
    assert summary_lines(Results("t", audits=[dataclasses.replace(audit, test_samples=0)]))[
        0
    ].endswith("nothing can leak.")


def test_pairs_by_signal():
    near = [LeakPair(SampleRef("a"), SampleRef("b"), 1)]
    strong = [LeakPair(SampleRef("a", "v"), SampleRef("b", "w"), None, 0.98, "nothing touched")]
    duplicates, gap = (
        Signal("near-duplicate touch", 1, 1, 0.9, worst=strong),
        Signal("time gap", 1, 1, 0.5, worst=near),
    )
    assert [p.kind for p in pair_lists(an_audit(near))] == [""]
    assert [p.kind for p in pair_lists(an_audit(near, signals=[duplicates]))] == [
        "",
        "near-duplicate touch",
    ]
    assert [p.kind for p in pair_lists(an_audit(near, signals=[gap, duplicates]))] == [
        "time gap",
        "near-duplicate touch",
    ]
    assert pair_lists(an_audit()) == []
    titles = [
        p.title
        for p in pair_lists(
            an_audit(near, signals=[duplicates, dataclasses.replace(gap, flagged=0)])
        )
    ]
    assert titles == ["near-duplicate touch: 1 pair", "time gap: 1 pair, none flagged"]
    assert pair_facts(strong[0], "near-duplicate touch") == [
        "another video",
        "score 0.980",
        "near-duplicate touch",
        "nothing touched: no leak",
    ]
    assert pair_facts(near[0], "") == ["1 frame apart"]
    assert pair_facts(strong[0], "")[0] == "gap unknown"


def test_lists_of_pairs_take_turns_when_there_is_little_room(tmp_path):
    names = pictures(tmp_path, 24, 100)
    audit = full_audit(names, worst=(), impact=None, matrix=(), materials=())
    generous = len(written(Results("T", audits=[audit]), tmp_path)[1])
    _, html = written(Results("T", audits=[audit]), tmp_path, max_bytes=generous // 5)
    tree = Tree(html)
    shown = {
        kind: len(re.findall(rf"· {kind}", tree.text))
        for kind in ("identical bytes", "time gap", "near-duplicate vision")
    }
    assert "rows of pictures were left out" in tree.text
    assert max(shown.values()) - min(shown.values()) <= 1
    assert "of 8 pairs are on this page; the JSON names them all" in tree.text


def test_pairs_of_a_signal_without_any_picture_leave_no_holes(tmp_path):
    audit = full_audit()
    tree = Tree(written(Results("T", audits=[audit]), tmp_path)[1])
    assert "2022_06_00_1137 frame 0" in tree.text
    assert "not recorded" not in tree.text
    half = [
        dataclasses.replace(s, worst=[*s.worst[:1], *pairs(["absent.png"], 1)])
        for s in audit.signals
    ]
    assert (
        "not recorded"
        in Tree(written(Results("T", audits=[full_audit(signals=half)]), tmp_path)[1]).text
    )


def test_matrix_shades_each_group_by_its_own_samples():
    rows = [
        {"group": "a", "train": 30, "val": None, "test": 10, "leaking": 10},
        {"group": None, "train": 0, "val": 0, "test": 5, "leaking": 0},
    ]
    view = matrix_view(full_audit(matrix=rows, groups_in_all=2))
    assert list(view.parts) == ["train", "test"]
    assert [list(r.cells) for r in view.rows] == [
        [("30", 0.75), ("10", 0.25)],
        [("0", 0.0), ("5", 1.0)],
    ]
    assert (view.rows[1].group, view.more) == ("not given", 0)
    rows[1]["val"] = 5
    assert list(matrix_view(full_audit(matrix=rows)).parts) == ["train", "val", "test"]
    cut = matrix_view(full_audit(matrix=matrix(200), groups_in_all=5000))
    assert (len(cut.rows), cut.more) == (MATRIX_ROWS, 5000 - MATRIX_ROWS)
    assert matrix_view(full_audit(matrix=())) is None


def test_impact_bars_share_an_axis():
    view = impact_view(impact())
    assert [c.value for _, *cells, _ in view.rows for c in cells] == [
        "71.4",
        "38.2",
        "33.2",
        "52.2",
        "34.7",
        "17.5",
        "61.0",
        "40.1",
        "20.9",
    ]
    assert view.rows[2][1].interval == ""
    places = {}
    for row, given, clean, *_ in view.rows:
        for value, cell in ((row.given, given), (row.clean, clean)):
            root = svg(cell.bar)
            places[value] = float(next(e for e in root if e.get("class") == "value").get("cx"))
            chance = float(next(e for e in root if e.get("class") == "floor").get("x1"))
    slope = (places[0.714] - places[0.347]) / (0.714 - 0.347)
    for value, x in places.items():
        assert x == pytest.approx(places[0.347] + slope * (value - 0.347), abs=0.02)
    assert chance == pytest.approx(places[0.347] + slope * (0.0526 - 0.347), abs=0.02)
    assert impact_view(None) is None
    assert impact_view(dataclasses.replace(impact(), rows=[])) is None
    flat = ImpactRow("x", "1-NN", 0.0, 0.0, 0.0, None, None, None, 0.0)
    assert impact_view(dataclasses.replace(impact(), rows=[flat])).rows[0][1].value == "0.0"


def test_text_of_audits_is_escaped_everywhere(tmp_path):
    sample = SampleRef(NASTY, NASTY, 1, NASTY, f"{NASTY}.png")
    signal = calibrated(
        kind=NASTY,
        causes={NASTY: 3},
        worst=[LeakPair(sample, sample, 2, 0.5, NASTY)],
        notes=[NASTY],
    )
    cost = dataclasses.replace(
        impact(),
        rows=[dataclasses.replace(impact().rows[0], features=NASTY, classifier=NASTY)],
        headline=NASTY,
        group=NASTY,
        notes=[NASTY],
        clean_splits=[NASTY],
        settings={NASTY: NASTY},
    )
    audit = an_audit(
        name=NASTY,
        group=NASTY,
        against=NASTY,
        signals=[signal, dataclasses.replace(signal, kind=f"shared {NASTY}")],
        impact=cost,
        matrix=[{"group": NASTY, "train": 1, "val": 1, "test": 1, "leaking": 1}],
        commands=[NASTY],
    )
    _, html = written(Results("T", audits=[audit]), tmp_path)
    assert "<script" not in html
    assert not Tree(html).all("script")
    text = (tmp_path / "page.md").read_text()
    assert not re.search(r"(?<!\\)<", re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.S))


def test_markdown_and_json_carry_the_same(tmp_path):
    results = Results("T", audits=[full_audit(pictures(tmp_path, 4, 16)), pretraining_audit()])
    files, _ = written(results, tmp_path)
    text = files.markdown.read_text()
    for said in (
        "### Orig: 99.10 % leaked",
        "29,611 of 29,879 test samples leak",
        "| near-duplicate touch  |",
        "score 0.872",
        "sensor drift 88 (no leak)",
        "0.850 to 0.875",
        "| touch pixels, 1-NN",
        "33.2 [26.2, 40.1]",
        "Worst pairs by near-duplicate vision: 8 pairs",
        "score 0.970",
        "And 66 more groups.",
        "| 20220607\\_130000 |",
        "### Test against the pretraining data: pretrain.csv / test: 1.3 % leaked",
        "palpate split data/manifest.parquet",
    ):
        assert said in text, said
    tables = [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.M)]
    assert len(tables) >= 8
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table}) == 1
    again = Results.load(files.json)
    assert json.dumps(again.to_json()) == json.dumps(results.to_json())
    assert again.audits[0].impact.rows == list(results.audits[0].impact.rows)
    assert render_markdown(again) == text


def test_paths_of_all_pairs_move_and_nothing_else_changes(tmp_path):
    results = Results("T", audits=[full_audit([f"p{k}.png" for k in range(8)])])
    moved = with_paths(results, lambda name: f"sub/{name}")
    back = with_paths(moved, lambda name: name.removeprefix("sub/"))
    assert json.dumps(back.to_json()) == json.dumps(
        results.to_json()
    )  # lists and tuples are the same in JSON
    pair = moved.audits[0].signals[5].worst[2]
    before = results.audits[0].signals[5].worst[2]
    assert (pair.test.vision, pair.score, pair.cause) == (
        f"sub/{before.test.vision}",
        0.966,
        "nothing touched",
    )
    (tmp_path / "out").mkdir()
    files = write_report(results, tmp_path / "out" / "page.html", base=tmp_path)
    assert (
        Results.load(files.json).audits[0].signals[4].worst[0].train.tactile
        == f"../{results.audits[0].signals[4].worst[0].train.tactile}"
    )


@pytest.mark.slow
def test_page_of_many_big_pictures_stays_under_ten_megabytes(tmp_path):
    rng = np.random.default_rng(1)
    sources = []
    for k in range(16):
        sources.append(f"big{k}.jpg")
        Image.fromarray(rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)).save(
            tmp_path / sources[-1], quality=95
        )
    names = many_names(tmp_path, sources, 1000)
    rows = [
        {"material": f"m{k}", "train": 5000, "test": 1000, "groups_train": 9, "groups_test": 7}
        for k in range(200)
    ]
    audits = [
        full_audit(
            signals=signals(names[500 * k : 500 * (k + 1)], worst=40),
            matrix=matrix(400),
            groups_in_all=100_000,
            materials=rows,
            test_samples=100_000,
        )
        for k in range(2)
    ]
    files, html = written(Results("T", audits=audits), tmp_path)
    shown = Tree(html).all("img")
    weight = sum((tmp_path / name).stat().st_size for name in names)
    assert weight > 100_000_000
    assert 4_000_000 < files.page.stat().st_size <= 10_000_000
    assert len(shown) == 2 * 4 * (3 + 4 + 3 * 24)  # all rows that a page holds, in smaller pictures
    assert max(int(a["width"]) for a in shown) < 256
    with pytest.raises(PalpateError, match="largest size must hold at least its text"):
        written(Results("T", audits=audits), tmp_path, max_bytes=30_000)
