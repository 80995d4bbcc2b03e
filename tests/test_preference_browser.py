"""The page of a study in a browser: raters by key, mouse and touch, from disk and from the server.

Screenshots are kept in ``$PALPATE_ARTIFACTS``, if that is set.
"""

import json
import os
from contextlib import suppress
from pathlib import Path

import pytest

from conftest import ARGS, CHROMIUM
from forge.people import READY, Person, opened, pair_study, sort_study
from palpate.core import digest_json
from palpate.preference.page import study_page

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytestmark = pytest.mark.browser

OVERFLOW = """document.documentElement.scrollWidth > innerWidth
    || [...document.querySelectorAll('body *')].some(e => e.checkVisibility()
        && !e.closest('option') && e.getBoundingClientRect().right > innerWidth + 0.5)"""
#: Of every visible control: its place, and whether a finger hits it (44 by 44 pixels, WCAG 2.5.5).
SMALL = """[...document.querySelectorAll('button, select')].filter(e => e.checkVisibility())
    .filter(e => Math.min(e.getBoundingClientRect().width, e.getBoundingClientRect().height) < 44)
    .map(e => e.textContent)"""
STORED = "JSON.stringify(Object.entries(localStorage).sort())"


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """A study of six pairs and two raters on disk."""
    public, ours = pair_study(6, 2)
    return on_disk(tmp_path_factory.mktemp("pairs"), public), public, ours


def on_disk(folder, public):
    """The URL of a study's page that is written to a folder."""
    (folder / "study.html").write_text(study_page(public), encoding="utf-8")
    return (folder / "study.html").as_uri()


def orders(public, code):
    return [row["trial"] for row in public["raters"][code]]


def test_keys_mouse_and_touch_vote_and_a_download_has_the_digest_of_its_votes(chromium, pairs):
    url, public, _ = pairs
    with opened(chromium, has_touch=True) as context:
        person = Person(context.new_page(), url, "r01")
        for key in "123":
            person.press(key)
        person.next(lambda: person.page.click("[data-choice=right]"))
        person.next(lambda: person.page.tap("[data-choice=same]"))
        person.next(lambda: person.page.tap("[data-choice=left] img"))
        assert person.done()
        votes = person.download()
    choices = [*public["choices"], "right", "same", "left"]
    assert [vote["choice"] for vote in votes["votes"]] == choices
    assert [vote["trial"] for vote in votes["votes"]] == orders(public, "r01")
    assert all(0 <= vote["ms"] < 60000 and vote["undone"] == 0 for vote in votes["votes"])
    assert votes["digest"] == digest_json({k: v for k, v in votes.items() if k != "digest"})
    assert (votes["format"], votes["study"]) == ("palpate/preference-votes@1", public["study"])
    assert votes["viewport"] == [1280, 800]


def test_the_keyboard_alone_is_enough(chromium, pairs):
    with opened(chromium) as context:
        page = context.new_page()
        page.goto(pairs[0])
        page.wait_for_selector("#start:not([hidden])")
        page.keyboard.press("Tab")
        page.keyboard.type("r01")
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        page.wait_for_selector(READY)
        person = Person(page)
        person.press("2")
        page.keyboard.press("Tab")  # to the left image, by Enter
        assert page.evaluate("document.activeElement.dataset.choice") == "left"
        person.press("Enter")
        person.press("Space")
        page.keyboard.press("u")
        page.wait_for_selector("#undo:disabled")
        assert person.place == "Trial 3 of 6"
        person.next(lambda: page.keyboard.press("3"))
        person.finish()
        page.keyboard.press("Tab")
        assert person.done()
        assert list(person.choices().values()) == ["right", "left", "same", "left", "left", "left"]


def test_a_key_held_down_and_a_double_click_are_one_vote(chromium, pairs):
    with opened(chromium) as context:
        person = Person(context.new_page(), pairs[0], "r01")
        page = person.page
        page.keyboard.down("1")
        for _ in range(5):
            page.keyboard.down("1")
        page.keyboard.up("1")
        page.get_by_text("Trial 2 of 6").wait_for()
        page.wait_for_selector(READY)
        page.dblclick("[data-choice=same]")
        page.wait_for_timeout(200)
        assert list(person.choices().values()) == ["left", "same"]


def test_undo_shows_the_last_trial_again_and_a_reload_the_same_one(chromium, pairs):
    with opened(chromium) as context:
        person = Person(context.new_page(), pairs[0], "r01")

        def same_after_a_reload(trial):
            assert person.trial == trial
            person.page.reload()
            person.page.wait_for_selector(READY)
            assert person.trial == trial

        first = person.trial
        person.press("1")
        person.next(lambda: person.page.click("#undo"))
        assert person.page.is_disabled("#undo")
        same_after_a_reload(first)
        person.press("2")
        person.press("3")
        same_after_a_reload(person.trial)
        assert person.place == "Trial 3 of 6"
        votes = person.download()["votes"]
        assert [(v["choice"], v["undone"]) for v in votes] == [("right", 1), ("same", 0)]
        person.finish()
        person.page.keyboard.press("u")  # also of the last trial
        person.page.wait_for_selector(READY)
        assert person.place == "Trial 6 of 6"


def test_after_a_crash_the_page_goes_on_at_the_same_trial(chromium, pairs, tmp_path):
    options = {"executable_path": str(CHROMIUM), "args": ARGS}
    launch = chromium.browser_type.launch_persistent_context
    context = launch(tmp_path / "profile", **options)
    person = Person(context.new_page(), pairs[0], "r01")
    person.press("1")
    person.press("3")
    trial = person.trial
    with suppress(sync_api.Error):  # nothing answers any more
        context.new_cdp_session(person.page).send("Browser.crash")
    with launch(tmp_path / "profile", **options) as context:
        page = context.new_page()
        page.goto(f"{pairs[0]}#r01")
        page.wait_for_selector(READY)
        assert Person(page).trial == trial
        assert list(Person(page).choices().values()) == ["left", "same"]


def test_two_tabs_of_one_rater_count_a_vote_once(chromium, pairs):
    url, public, _ = pairs
    with opened(chromium) as context:
        one = Person(context.new_page(), url, "r01")
        other = context.new_page()
        other.goto(f"{url}#r01")
        two = Person(other)
        two.start()
        assert one.trial == two.trial
        one.press("1")
        other.wait_for_selector(f"#trial[data-trial='{one.trial}']")
        assert two.place == "Trial 2 of 6"
        two.press("2")
        one.page.wait_for_selector(f"#trial[data-trial='{two.trial}']")
        assert one.place == "Trial 3 of 6"
        # A tab that slept through the vote of the other does not vote on the same trial.
        other.evaluate("addEventListener('storage', e => e.stopImmediatePropagation(), true)")
        trial = one.trial
        vote = {"choice": "same", "ms": 1, "at": "2030-01-01T00:00:00Z", "undone": 0}
        stored = [f"palpate/{public['study']}/r01/{trial}", json.dumps(vote)]
        other.evaluate("([key, vote]) => localStorage.setItem(key, vote)", stored)
        two.press("1")
        assert other.inner_text("#message") == "Answered in another tab: here is the next."
        assert list(two.choices().values()) == ["left", "right", "same"]


def test_two_raters_at_one_computer_do_not_mix(chromium, pairs):
    url, public, _ = pairs
    with opened(chromium) as context:
        first = Person(context.new_page(), url, "r01")
        first.finish()
        first.page.click("#another")
        first.page.select_option("#rater", "r02")
        assert first.page.inner_text("#begin button") == "Start"
        first.page.click("#begin button")
        first.page.wait_for_selector(READY)
        first.press("2")
        assert first.choices() == {orders(public, "r02")[0]: "right"}


def test_a_browser_that_keeps_nothing_says_so_and_still_downloads(chromium, pairs):
    with opened(chromium) as context:
        context.add_init_script("Storage.prototype.setItem = () => { throw new Error('full') }")
        person = Person(context.new_page(), pairs[0], "r01")
        person.finish()
        assert "download your votes before" in person.page.inner_text("#kept")
        assert len(person.choices()) == 6


def test_a_browser_that_closes_its_database_still_takes_every_vote(chromium, pairs):
    with opened(chromium) as context:
        person = Person(context.new_page(), pairs[0], "r01")
        person.page.evaluate(
            "() => { IDBDatabase.prototype.transaction = () => { throw Error('closed') } }"
        )
        person.finish()  # one press a trial
        assert len(person.choices()) == 6


@pytest.mark.parametrize(
    ("public", "words"),
    [
        (pair_study(36, 1)[0], ("36 times", "Same if you cannot tell", "about 3 minutes")),
        (sort_study(12), ("12 times", "examples of every answer", "about 1 minute;")),
    ],
    ids=["pair", "sort"],
)
def test_the_start_says_what_to_do_how_long_it_takes_and_what_is_recorded(
    chromium, tmp_path, public, words
):
    url = on_disk(tmp_path, public)
    with opened(chromium) as context:
        page = context.new_page()
        page.goto(url)
        page.wait_for_selector("#start:not([hidden])")
        text = page.inner_text("#start")
    assert all(word in text for word in (*words, "a touch sensor", "Recorded", "nothing else"))


def test_screen_readers_hear_names(chromium, pairs):
    with opened(chromium) as context:
        person = Person(context.new_page(), pairs[0], "r01")
        page = person.page
        tree = page.locator("body").aria_snapshot()
        for name in ('button "Left"', 'button "Right"', 'button "Same"', 'img "Reference image"'):
            assert name in tree, tree
        assert 'group "Which image is closer' in tree
        assert 'progressbar "Trial 1 of 6"' in tree
        assert 'heading "Which image' in tree
        assert page.get_attribute("[data-choice=left]", "aria-keyshortcuts") == "1"
        assert page.get_attribute("#kept", "aria-live") == "polite"
        assert page.evaluate("document.documentElement.lang") == "en"
        person.finish()
        assert page.evaluate("document.activeElement.textContent") == "Done. Thank you."


@pytest.mark.parametrize(
    ("width", "height", "scheme"), [(1280, 800, "light"), (390, 844, "dark"), (320, 640, "light")]
)
@pytest.mark.parametrize("task", ["pair", "sort"])
def test_the_page_fits_the_screen(chromium, tmp_path, task, width, height, scheme):
    public = pair_study(2, 2)[0] if task == "pair" else sort_study(2, materials=MANY)
    url = on_disk(tmp_path, public)
    viewport = {"width": width, "height": height}
    with opened(chromium, viewport=viewport, color_scheme=scheme) as context:
        page = context.new_page()
        code = "r01" if task == "pair" else None
        page.goto(url)
        assert not page.evaluate(OVERFLOW)
        person = Person(page, url, code)
        if folder := os.environ.get("PALPATE_ARTIFACTS"):
            page.screenshot(path=Path(folder) / f"study-{task}-{width}-{scheme}.png")
        assert not page.evaluate(OVERFLOW)
        assert page.evaluate(SMALL) == []
        if task == "pair" and width > 320:  # all of a trial at once
            assert page.evaluate("document.documentElement.scrollHeight <= innerHeight")
        if task == "pair":
            sides = page.evaluate(
                "[...document.querySelectorAll('#trial img')].map(i => Math.round(i.width))"
            )
            assert max(sides) - min(sides) <= 1
            assert min(sides) > 100
        person.finish()
        assert not page.evaluate(OVERFLOW)


MANY = ["Brick", "Grass", "A material with a long name", *(f"Material {k}" for k in range(10))]


def test_sorting_takes_a_key_a_material(chromium, tmp_path):
    public = sort_study(materials=MANY)
    url = on_disk(tmp_path, public)
    with opened(chromium) as context:
        person = Person(context.new_page(), url)
        assert person.page.locator(".examples img").count() == 3 * len(MANY)
        person.press("1")
        person.press("0")  # the tenth
        person.press("c")  # the thirteenth
        person.next(lambda: person.page.click("text=A material with a long name"))
        votes = list(person.choices().values())
    assert votes == [MANY[0], MANY[9], MANY[12], MANY[2]]


def test_names_of_strangers_run_no_script(chromium, tmp_path):
    evil = "</script><img src=x onerror=alert(1)><script>alert(2)</script>"
    public = sort_study(materials=[evil, "Wood"], title=evil, question=evil)
    url = on_disk(tmp_path, public)
    with opened(chromium) as context:
        page = context.new_page()
        page.on("dialog", lambda dialog: context.messages.append(dialog.message))
        person = Person(page, url + "#<img src=x onerror=alert(3)>")
        assert person.page.inner_text("#question") == evil
        person.press("1")
        assert set(person.choices().values()) == {evil}
        assert page.evaluate("[...document.images].every(i => i.src.startsWith('data:'))")


def test_a_script_that_gets_into_the_page_is_stopped_by_the_policy(chromium, tmp_path):
    url, file = on_disk(tmp_path, pair_study(2, 1)[0]), tmp_path / "study.html"
    planted = "<script>document.title = 'taken'</script><footer"
    file.write_text(file.read_text("utf-8").replace("<footer", planted), encoding="utf-8")
    page = chromium.new_page()
    page.goto(url)
    page.wait_for_selector("#start:not([hidden])")
    assert page.title() == "Tactile images"
    page.close()


def test_after_the_last_day_nothing_is_asked(chromium, tmp_path):
    public = pair_study(3, 1, until="2020-01-31")[0]
    url = on_disk(tmp_path, public)
    with opened(chromium) as context:
        page = context.new_page()
        page.goto(url)
        page.click("#begin button")
        page.wait_for_selector("#end:not([hidden])")
        assert page.inner_text("#thanks") == "This study ended on 2020-01-31."
        page.keyboard.press("1")
        assert json.loads(page.evaluate(STORED)) == []
