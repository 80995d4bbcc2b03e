"""Raters at the page of a study in a browser, who see and do what people can."""

import json
import re
import time
from contextlib import contextmanager
from pathlib import Path

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
        ways = [
            (code, *WAYS[k % 3]) for k, code in enumerate(codes) if code in codes[start:][:at_once]
        ]
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
