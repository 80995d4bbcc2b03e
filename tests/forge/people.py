"""Raters: what they prefer, what they see in a browser and do, and the studies they answer."""

import base64
import hashlib
import io
import json
import re
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from forge.pictures import paint
from palpate import preference
from palpate.core import digest_json, rng_for

# --- studies by hand in the public form, as the page and the server get them


#: What the names of methods are in these studies; they must be nowhere on the page.
METHODS = ("ours-secret", "gvst-secret")
MATERIALS = ("Brick", "Grass", "Wood")


def name_of(*parts):
    """A name that says nothing."""
    return hashlib.sha256("/".join(map(str, parts)).encode()).hexdigest()[:20]


def picture(*parts, side=64):
    """A texture as the page has it."""
    seed = int(name_of(*parts)[:8], 16)
    noise = np.random.default_rng(seed).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    file = io.BytesIO()
    Image.fromarray(noise).resize((side, side), Image.Resampling.BICUBIC).save(file, "jpeg")
    source = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
    return {"src": source, "w": side, "h": side}


def pair_study(trials=6, raters=2, **changes):
    """A study of pairs; with the first of :data:`METHODS` on the side that ``ours`` gives.

    Returns:
        The public form, and ``ours``: (rater, trial) -> "left" or "right".
    """
    items = [(k, slot) for k in range(trials) for slot in (*METHODS, "reference")]
    orders, ours = {}, {}
    for r in range(raters):
        code, rng = f"r{r + 1:02}", np.random.default_rng(r)
        orders[code] = []
        for k in rng.permutation(trials).tolist():
            swapped = bool(rng.integers(2))
            sides = METHODS[::-1] if swapped else METHODS
            names = [name_of(k, slot) for slot in ("reference", *sides)]
            row = dict(zip(("reference", "left", "right"), names, strict=True))
            orders[code].append({"trial": name_of("trial", k)} | row)
            ours[code, name_of("trial", k)] = "right" if swapped else "left"
    public = {
        "format": "palpate/preference-page@1",
        "study": name_of("study", trials, raters)[:12],
        "task": "pair",
        "title": "Tactile images",
        "question": "Which image is closer to the reference in the pattern of its material?",
        "until": None,
        "images": {name_of(*item): picture(*item) for item in items},
        "raters": orders,
        "choices": ["left", "right", "same"],
    }
    return public | changes, ours


def sort_study(trials=4, raters=1, materials=MATERIALS, **changes):
    """A study of sorting; every strip has three examples."""
    strips = [
        {"answer": m, "label": m, "images": [name_of(m, k) for k in range(3)]} for m in materials
    ]
    images = {name_of(m, k): picture(m, k) for m in materials for k in range(3)}
    images |= {name_of("sorted", k): picture("sorted", k) for k in range(trials)}
    rows = [{"trial": name_of("sort", k), "image": name_of("sorted", k)} for k in range(trials)]
    public = {
        "study": name_of("sorting", trials)[:12],
        "task": "sort",
        "question": "Which material is this?",
        "images": images,
        "raters": {f"r{r + 1:02}": rows for r in range(raters)},
        "strips": strips,
        "choices": list(materials),
    }
    return pair_study(1, 1)[0] | public | changes


# --- raters who answer with planted preferences


def write_folder(folder, seed, ids, size=24, suffix=".png"):
    """A folder of random images, one an id; the color is that of ``seed``."""
    paint(folder, ids, seed, suffix, size, 0, 255)
    return folder


@dataclass(frozen=True)
class Folders:
    """A reference, three methods, and a table of materials and videos."""

    reference: Path
    methods: list[Path]
    labels: Path

    def make(self, output=None, count=3, **options):
        """The plan of a study of the first methods; without a folder nothing is written."""
        options = {"labels": self.labels, "dry_run": output is None} | options
        return preference.make(self.reference, self.methods[:count], output, **options)


def write_folders(top, videos=30, frames=2, materials=("brick", "grass", "wood")):
    """``videos`` videos of ``frames`` images each, materials in turn."""
    of_video = [(f"v{v:02d}", materials[v % len(materials)]) for v in range(videos)]
    rows = [(f"{v}/f{f}", material, v) for v, material in of_video for f in range(frames)]
    ids = [row[0] for row in rows]
    labels = top / "labels.csv"
    reference = write_folder(top / "real", 0, ids)
    methods = [write_folder(top / n, k, ids) for k, n in enumerate(("ours", "gvst", "wbg"), 1)]
    labels.write_text("\n".join(["id,material,video", *(",".join(row) for row in rows)]) + "\n")
    return Folders(reference, methods, labels)


@dataclass(frozen=True)
class Crowd:
    """Simulated raters: what they find closer, and how carelessly they answer.

    A method has a strength in logits, which varies between items and between raters: the difference
    of two methods has the standard deviations ``item_sd`` and ``rater_sd``. A difference felt below
    ``tie_band`` is a tie; ``left_bias`` is added for the left image; a share ``lapses`` of the
    answers is random. A sorter names the material with probability ``skill``.
    """

    strengths: dict[str, float]
    item_sd: float = 1.5
    rater_sd: float = 0.7
    tie_band: float = 0.5
    left_bias: float = 0.0
    lapses: float = 0.0
    skill: float = 0.7
    seed: int = 0

    def _rng(self, *names):
        return rng_for(self.seed, *names)

    def strength(self, rater, item, method):
        """Strength that one rater feels in one image."""
        of_item = self._rng("item", item, method).standard_normal() * self.item_sd / np.sqrt(2)
        return self.strengths[method] + of_item + self._of_rater(rater, method)

    def choice(self, plan, rater, trial, swapped):
        """The answer to one trial, as shown."""
        rng = self._rng("vote", rater, trial.id)
        if rng.random() < self.lapses:
            return plan.choices[rng.integers(len(plan.choices))]
        if plan.task == "sort":
            truth = {item.id: item.material for item in [*plan.items, *plan.examples]}[trial.item]
            others = [name for name in plan.choices if name != truth]
            sure = trial.kind == "catch" or rng.random() < self.skill
            return truth if sure else others[rng.integers(len(others))]
        left, right = (trial.right, trial.left) if swapped else (trial.left, trial.right)
        if trial.kind == "catch":
            return "left" if left == "copy" else "right"
        felt = self.strength(rater, trial.item, left) - self.strength(rater, trial.item, right)
        felt += self.left_bias + rng.logistic()
        return "same" if abs(felt) < self.tie_band else "left" if felt > 0 else "right"

    def preference(self, a, b, draws=400_000):
        """The planted truth: preference of a over b among all items, sides, and people."""
        rng, mean = np.random.default_rng(0), self.strengths[a] - self.strengths[b]
        felt = mean + self.rater_sd * rng.standard_normal(draws)
        felt += self.item_sd * rng.standard_normal(draws)
        felt += self.left_bias * rng.choice([-1, 1], draws) + rng.logistic(size=draws)
        same = np.abs(felt) < self.tie_band
        share = float(((felt > 0) & ~same).mean() + same.mean() / 2)
        return (1 - self.lapses) * share + self.lapses / 2

    def _of_rater(self, rater, method):
        return self._rng("rater", rater, method).standard_normal() * self.rater_sd / np.sqrt(2)

    def download(self, plan, rater):
        """What the page of one rater downloads."""
        rows = [
            {
                "trial": name,
                "choice": self.choice(plan, rater, trial, swapped),
                "ms": 2500,
                "at": f"2026-11-01T{10 + k // 3600:02d}:{k // 60 % 60:02d}:{k % 60:02d}.000Z",
                "undone": 0,
            }
            for k, (name, (trial, swapped)) in enumerate(plan.shown(rater).items())
        ]
        head = {"format": "palpate/preference-votes@1", "study": plan.study, "rater": rater}
        return signed(head | {"viewport": [1280, 800], "votes": rows})

    def write(self, plan, folder, raters=None):
        """Downloads of all raters, or of some, in a folder."""
        folder.mkdir(exist_ok=True)
        for rater in raters or [rater.code for rater in plan.raters]:
            path = folder / f"votes-{plan.study}-{rater}.json"
            path.write_text(json.dumps(self.download(plan, rater)))
        return folder


def signed(download):
    """A download with the digest of its content."""
    rest = {name: value for name, value in download.items() if name != "digest"}
    return rest | {"digest": digest_json(rest)}


# --- raters at the page in a browser, who see and do what people can


#: The name of a trial is there once its images are.
READY = "#trial:not([hidden])[data-trial]"


class Person:
    """A rater at a page.

    Args:
        page: of playwright.
        url: of the study; None where the page is open and started.
        code: chosen at the start; None where an invitation says who it is.
    """

    def __init__(self, page, url=None, code=None):
        self.page = page
        if url:
            page.goto(url)
            page.wait_for_selector("#start:not([hidden])")
            self.start(code)

    def start(self, code=None):
        """Choose a code, where there is a choice, and begin."""
        if code:
            self.page.select_option("#rater", code)
        self.page.click("#begin button")
        self.page.wait_for_selector(READY)

    @property
    def trial(self):
        """Name of the trial on the screen."""
        return self.page.get_attribute("#trial", "data-trial")

    @property
    def place(self):
        return self.page.inner_text("#progress-name")

    def next(self, act):
        """Do something and wait for another trial, or for the end."""
        before = self.trial
        act()
        self.page.wait_for_function(
            "before => !document.querySelector('#end').hidden"
            " || document.querySelector('#trial').dataset.trial !== before",
            arg=before,
        )

    def press(self, key):
        self.next(lambda: self.page.keyboard.press(key))

    def done(self):
        return self.page.is_visible("#end")

    def finish(self, key=lambda trial: "1"):
        """Answer all trials by the key that a function of the trial gives."""
        while not self.done():
            self.press(key(self.trial))

    def download(self):
        with self.page.expect_download() as download:
            self.page.click("#download")
        votes = json.loads(Path(download.value.path()).read_text())
        assert download.value.suggested_filename == f"votes-{votes['study']}-{votes['rater']}.json"
        return votes

    def choices(self):
        return {vote["trial"]: vote["choice"] for vote in self.download()["votes"]}


@contextmanager
def opened(chromium, *, quiet=True, **options):
    """A browser context; what it requests is one file or one server, and it prints nothing."""
    context = chromium.new_context(**{"viewport": {"width": 1280, "height": 800}} | options)
    context.set_default_timeout(120_000)  # a busy machine was seen to stand still for 40 s
    messages, urls = [], []
    context.on("console", lambda message: messages.append(message.text))
    context.on("weberror", lambda error: messages.append(str(error.error)))
    context.on("request", lambda request: urls.append(request.url))
    context.urls, context.messages = urls, messages
    yield context
    context.close()
    assert messages == [] or not quiet
    sources = {re.sub(r"(http://[^/]*/).*|[#?].*", r"\1", url) for url in urls}
    assert len({url for url in sources if not url.startswith(("data:", "blob:"))}) == 1


#: What the page says once all votes are where they shall be.
SAFE = re.compile(r"All votes are at the server\.|votes kept in this browser\.")
#: Of every third rater: a screen, and what is used to answer.
WAYS = [
    ({"width": 1280, "height": 800}, "key"),
    ({"width": 1024, "height": 768}, "click"),
    ({"width": 390, "height": 844}, "tap"),
]


class Rating:
    """One simulated rater at the page: answers as the crowd does, in a way of its own."""

    def __init__(self, context, crowd, plan, code, url, way):
        self.crowd, self.plan, self.code, self.way = crowd, plan, code, way
        self.shown = plan.shown(code)
        self.person = Person(context.new_page(), url, None if "token" in url else code)
        self.since = time.monotonic()

    def step(self):
        """Answer one trial; whether another one follows."""
        page = self.person.page
        choice = self.crowd.choice(self.plan, self.code, *self.shown[self.person.trial])
        if self.way == "key":
            self.person.press(str(1 + self.plan.choices.index(choice)))
        else:  # a second tap within 0.3 s is that of a double tap, and no vote
            time.sleep(max(0, 0.4 - (time.monotonic() - self.since)))
            act = getattr(page, self.way)
            self.person.next(lambda: act(f"[data-choice={choice}]"))
        self.since = time.monotonic()
        return not self.person.done()


def rate(chromium, crowd, plan, url_of, at_once=8):
    """All raters, ``at_once`` at a time, in turns; what they download."""
    downloads, codes = [], [rater.code for rater in plan.raters]
    for start in range(0, len(codes), at_once):
        ways = [(c, *WAYS[k % 3]) for k, c in enumerate(codes) if c in codes[start:][:at_once]]
        contexts = [
            chromium.new_context(viewport=size, has_touch=way == "tap") for _, size, way in ways
        ]
        rating = [
            Rating(context, crowd, plan, code, url_of(code), way)
            for context, (code, _, way) in zip(contexts, ways, strict=True)
        ]
        going = list(rating)
        while going:
            going = [rater for rater in going if rater.step()]
        for rater in rating:
            rater.person.page.get_by_text(SAFE).wait_for()
            downloads.append(rater.person.download())
        for context in contexts:
            context.close()
    return downloads


def planted(crowd, plan):
    """(rater, name of the trial) -> choice."""
    return {
        (rater.code, name): crowd.choice(plan, rater.code, *trial)
        for rater in plan.raters
        for name, trial in plan.shown(rater.code).items()
    }
