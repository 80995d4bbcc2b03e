"""Results and audits with everything that they can hold, for tests of the report."""

import dataclasses
import json
from functools import partial
from html.parser import HTMLParser

import numpy as np
from PIL import Image

from palpate.core import Note, SampleRef, Score
from palpate.report.records import (
    Claim,
    GalleryItem,
    Impact,
    ImpactRow,
    LeakPair,
    Signal,
    StudyTable,
)
from palpate.report.results import Audit, Results

#: Gaps of Touch and Go's own split, as `palpate audit` finds them.
GAPS = {
    "gap_min": 31,
    "gap_median": 304,
    "gap_max": 2485,
    "gap_edges": [0, 1, 3, 10, 30, 60, 90, 150, 300, 600, 900, 1800, 2486],
    "gap_counts": [0, 0, 0, 0, 2400, 2210, 3500, 6590, 9012, 3001, 2115, 769],
}


def text_note(text):
    return Note("text", {"text": text})


def images(folder, n, side=128):
    """Write ``n`` gel pictures to ``folder``; return their names."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:side, 0:side] / side
    light = np.stack([0.6 - 0.3 * y, 0.5 + 0.1 * x, 0.45 + 0.3 * y], axis=-1)
    for k in range(n):
        a, b, phase = rng.uniform(5, 45), rng.uniform(5, 45), rng.uniform(0, 6)
        wave = 0.1 * np.sin(a * x + b * y + phase) * np.sin(b * x - a * y)
        relief = 255 * (light + wave[..., None] * np.array([1, -0.4, -1]))
        Image.fromarray(relief.clip(0, 255).astype(np.uint8)).save(folder / f"p{k}.png")
    return [f"p{k}.png" for k in range(n)]


def pairs(names, n, *, start=0, gap=True, score=0.97, causes=("",), prefix="2022_06_"):
    """``n`` pairs over the images ``names`` from ``start`` on, gaps growing, scores falling."""
    out = []
    for k in range(n):
        files = [names[(start + 4 * k + j) % len(names)] if names else None for j in range(4)]
        video = f"{prefix}{k % 7:02}_1137"
        other = video if gap else f"{prefix}{k % 7 + 8:02}_0842"
        test = SampleRef(f"{video}/{30 * k}", video, 30 * k, "wood", *files[:2])
        train = SampleRef(f"{other}/{30 * k + 31 + k}", other, 31 * k + 31, "wood", *files[2:])
        frames, likeness = 31 + k if gap else None, round(score - 0.002 * k, 4)
        out.append(LeakPair(test, train, frames, likeness, causes[k % len(causes)]))
    return out


def histograms(rng, low, high, n=29879, bins=80):
    """Edges, counts of unrelated pairs and of test samples: two humps."""
    edges, few = np.linspace(0, 1, bins + 1), int(0.8 * n)
    unrelated = np.histogram(rng.beta(low * 40, (1 - low) * 40, 12000), edges)[0]
    humps = [(low * 30, (1 - low) * 30, few), (high * 60, (1 - high) * 60, n - few)]
    counts = np.histogram(np.concatenate([rng.beta(*hump) for hump in humps]), edges)[0]
    return edges.round(6).tolist(), unrelated.tolist(), counts.tolist()


def signals(names=(), worst=8):
    """Every kind of signal."""
    rng, n = np.random.default_rng(0), 29879
    vision, touch = histograms(rng, 0.45, 0.93), histograms(rng, 0.62, 0.95)
    drifts = {"content": 3601, "nothing touched": 1204, "sensor drift": 88}
    causes = ("content", "content", "nothing touched", "sensor drift")
    near = partial(pairs, names, worst, gap=False)
    same = partial(pairs, names, score=1.0)
    late = pairs(names, worst, start=100, score=0.49)
    bytes_alike = same(min(worst, 4), start=400, gap=False)
    unread, within = "4 images could not be read.", "Flagged within 30 frames of a train frame."
    calibrated = [text_note("Calibrated on 12,000 pairs of different videos.")]
    seen, felt = near(start=200, causes=("content",)), near(start=300, causes=causes)
    content = {"content": 5210}
    return [
        Signal("identical sample", n, 12, 1.0, worst=same(min(worst, 3))),
        Signal("identical bytes", n - 4, 40, 1.0, worst=bytes_alike, notes=[text_note(unread)]),
        Signal("shared video", n, 29597, 1.0),
        Signal("time gap", 29597, 4610, 0.5, worst=late, notes=[text_note(within)]),
        Signal("near-duplicate vision", n, 5210, 0.8125, 0.001, *vision, content, seen),
        Signal("near-duplicate tactile", n, 3601, 0.872, 0.001, *touch, drifts, felt, calibrated),
    ]


def impact():
    """Two kinds of features, two classifiers; the last row has no intervals."""
    intervals = [
        [(0.66, 0.765), (0.31, 0.455), (0.262, 0.401)],
        [(0.47, 0.574), (0.283, 0.41), (0.102, 0.25)],
        [None, None, None],
    ]
    values = [
        ("tactile pixels", "1-NN", 0.714, 0.382, 0.332),
        ("tactile pixels", "linear probe", 0.522, 0.347, 0.175),
        ("tactile minus background", "1-NN", 0.61, 0.401, 0.209),
    ]
    headline = (
        "A 1-NN on tactile pixels reaches 71.4 % under this split and 38.2 % without the leak: it "
        "costs 33.2 points [26.2, 40.1]."
    )
    rows = zip(values, intervals, strict=True)
    rows = [ImpactRow(*value, *interval, 0.0526, "video") for value, interval in rows]
    settings, notes = {"size": 32, "seeds": [0, 1]}, [text_note("Nothing is whitened.")]
    return Impact(rows, headline, "video", ["c0" * 32, "c1" * 32], settings, notes)


def matrix(n=60):
    """``n`` groups: shared ones first."""
    rows = []
    for k in range(n):
        test = 610 - 9 * k if k < 0.8 * n else 0
        train = 1800 - 20 * k if k % 10 else 90
        group = f"20220607_13{k:04}"
        rows.append({"group": group, "train": train, "val": 0, "test": test, "leaking": test})
    return rows


def full_audit(names=(), **changes):
    """Touch and Go's own split with every signal, an impact and a matrix."""
    audit = Audit(
        *("Orig", "video", 91982, 29879, 120, 106, 100, 29597, 0.99056, 12),
        **GAPS,
        worst=pairs(names, 8),
        materials=[
            {"material": m, "train": 4600, "test": 1500, "groups_train": 9, "groups_test": 7}
            for m in ("brick", "grass", "wood")
        ],
        notes=[text_note("2 test samples have no video.")],
        split="9f" * 32,
        signals=signals(names),
        leaking_samples=29611,
        matrix=matrix(),
        groups_in_all=126,
        impact=impact(),
        commands=[
            "palpate split data/manifest.parquet --by video --near both -o noleak.json",
            "palpate audit data/manifest.parquet --split noleak.json",
        ],
    )
    return dataclasses.replace(audit, **changes)


def clean_audit(**changes):
    """A split in which nothing was found."""
    counts = ("NoLeak", "video", 97000, 24000, 101, 25, 0, 0, 0.0, 0)
    signals = [Signal("identical sample", 24000, 0, 1.0), Signal("shared video", 24000, 0, 1.0)]
    facts = {"split": "5b" * 32, "signals": signals, "groups_in_all": 126, "matrix": matrix(4)[:1]}
    return Audit(*counts, **(facts | changes))


def pretraining_audit(names=()):
    """The test part against data that an encoder has seen."""
    counts = ("pretrain.csv / test", "none", 4500, 24000, 0, 0, 0, 0, 0.0, 0)
    worst = pairs(names, 3, gap=False, score=1.0, prefix="ssvtp_")
    signals = [Signal("identical bytes", 24000, 310, 1.0, worst=worst)]
    signals += [Signal("shared video", 0, 0, 1.0)]
    return Audit(*counts, against="pretraining", signals=signals, leaking_samples=310)


def gallery(folder, n, side=64, materials=("wood", "rock", "grass")):
    rng = np.random.default_rng(0)
    items = []
    for k in range(n):
        names = [f"{kind}{k}.png" for kind in ("photo", "real", "generated")]
        for name in names:
            noise = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
            Image.fromarray(noise).save(folder / name)
        material = materials[k % len(materials)]
        sample = SampleRef(f"vid{k % 4}/{k}", f"vid{k % 4}", k, material, names[0], names[1])
        items.append(GalleryItem(sample, names[2]))
    return items


def score(metric="TMMD", subject="a", value=1.374, **changes):
    """A score with interval, null and floor."""
    fields = {
        "interval": (1.01, 1.75),
        "interval_method": "jackknife, t, 9 df",
        "null": (-0.05, 0.06),
        "floor": 0.042,
        "estimator": "unbiased",
        "bandwidth": 10.0,
        "scale": 1000.0,
        "n": 240,
    }
    return Score(metric, subject, value, **(fields | changes))


def difference(a, b, metric="TMMD", value=-1.0, better=None, **changes):
    """A paired difference a - b; decided if ``better`` is given."""
    details = {"better": better, "decided": better is not None}
    details |= {"p_better": 0.975, "p_adjusted": 0.05}
    fields = {"interval": (-1.5, -0.5), "n": 240, "details": details}
    return Score(metric, a, value, kind="difference", b=b, **(fields | changes))


def full_results(folder, n=6, side=64):
    """Results with every section of a page."""
    items = gallery(folder, n, side)
    matrix = {"matrix": [[0.1, 3.0], [3.0, 0.25]], "classes": ["wood", "rock"]}
    scores = [
        score(subject="generated", notes=(text_note("Small sample."),)),
        score(subject="background", value=None, notes=(text_note("one image for all"),)),
        score("D-TMMD", "generated", 0.44, interval=None, floor=0.1, details=matrix),
        score("SSIM", "generated", 0.49, interval=(0.47, 0.51), higher_is_better=True),
    ]
    settings = {
        "split": {"digest": "cd" * 32, "seed": 0},
        "many": list(range(1000)),
        "nothing": None,
        "classes": {"oak": {"n": 3, "E": 0.5}, "elm": {"n": 4, "E": 0.25}},
    }
    pair = LeakPair(items[0].sample, items[1].sample, 7)
    return Results(
        "A title",
        ["80.0 % leak."],
        [small_audit([pair])],
        scores,
        items,
        settings,
        [text_note("Synthetic data.")],
        ["palpate audit x"],
    )


def small_audit(worst=(), **changes):
    """An audit of groups and gaps alone."""
    materials = [{"material": "wood", "train": 5, "test": 6, "groups_train": 6, "groups_test": 3}]
    audit = Audit("Orig", "video", 900, 100, 10, 5, 4, 80, 0.8, 3, 1, 24.0, 60)
    fields = {"gap_edges": [0, 10, 30, 60], "gap_counts": [10, 40, 30], "worst": worst}
    fields |= {"materials": materials, "notes": [text_note("A remark.")], "split": "ab" * 32}
    fields |= {"signals": [Signal("shared video", 100, 80, 1.0)], "leaking_samples": 80}
    return dataclasses.replace(audit, **(fields | changes))


VOID = {"meta", "link", "img", "line", "rect", "path", "circle", "br", "hr"}


class Tree(HTMLParser):
    """Checks nesting; collects tags with their attributes, and the text."""

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


def study_results(folder, n=12, side=64):
    """A study: claims, tables with controls, next to every other section."""

    def measure(metric, subject, value, higher=False, spread=0.1, **changes):
        interval = tuple(sorted((value * (1 - spread), value * (1 + spread))))
        fields = {"interval": interval, "higher_is_better": higher, "details": {"stage": "score"}}
        return score(metric, subject, value, **(fields | changes))

    methods = ["Ours", "GVST", "Ours w/ BG", "Ours with memory bridge"]
    controls = ["real images of other videos", "nearest photo", "mean image"]
    rows = []
    for k, name in enumerate([*methods, *controls]):
        accuracy = measure("material accuracy", name, 0.9 - 0.1 * k, True, details={"chance": 0.1})
        lpips = None if k == 6 else measure("LPIPS", name, 0.3 + 0.01 * k, interval=None)
        gap = measure("D-TMMD", name, 0.2 * k - 0.3, None, 0.4, floor=0.1)
        if name == "GVST":
            note = text_note("One video a class.")
            gap = score("D-TMMD", name, None, higher_is_better=None, notes=(note,))
        rows.append([name, measure("TMMD", name, 1.2 + 0.7 * k), accuracy, gap, lpips])
    columns = ["method", "TMMD", "material accuracy", "D-TMMD", "LPIPS"]
    text = "Encoder and generator are trained once per split; both encoders judge both generators."
    compute = [[name, "random weights", f"{k + 2} min"] for k, name in enumerate(methods)]
    tables = [
        StudyTable("Table 4: generators", text, columns, rows, True, controls),
        StudyTable("Compute", "On two cores.", ["method", "starts from", "time"], compute),
    ]

    accuracy = [measure("accuracy", s, v, True) for s, v in (("Orig", 0.8), ("NoLeak", 0.5))]
    drop = "0.300 [0.200, 0.400] on average over 4 tasks and 3 seeds."
    claims = [
        Claim("Leakage inflates every task", "paper, table 1", "holds", drop, accuracy),
        Claim(
            "Text as a bridge beats images",
            "paper, table 4",
            "does not hold",
            "GVST is better by 0.2 [0.1, 0.3].",
            accuracy[:1],
        ),
        Claim(
            "FID prefers what people do not",
            "paper, section 4.2",
            "undecided",
            "No weights of Inception are at hand.",
        ),
    ]
    audits = [full_audit(images(folder, 16)), clean_audit()]
    results = dataclasses.replace(full_results(folder, n, side), audits=audits)
    return dataclasses.replace(results, tables=tables, claims=claims)


def edit(file, change):
    """Change the JSON of a results file by hand."""
    data = json.loads(file.read_text())
    change(data)
    file.write_text(json.dumps(data))
