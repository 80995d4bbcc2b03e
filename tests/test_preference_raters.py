"""Simulated raters in browsers, from disk and served: what they planted is what is scored.

Each is a browser context of its own, with a tie band, a left bias and lapses: 8 of them, or as many
as ``$PALPATE_RATERS`` says.
"""

import json
import os
import re
import resource

import pytest

from forge.people import Crowd, Person, opened, pair_study, planted, rate, write_folders
from forge.servers import Serving
from palpate import preference
from palpate.preference import Plan

pytest.importorskip("uvicorn", reason="uvicorn is not installed")
pytestmark = pytest.mark.browser

RATERS = int(os.environ.get("PALPATE_RATERS", "8"))
#: Names that no image spells by chance.
STRENGTHS = {"secret-ours": 0.9, "secret-gvst": 0.0, "secret-wbg": -0.9}
CROWD = Crowd(STRENGTHS, item_sd=1.0, rater_sd=0.5, left_bias=0.2, lapses=0.03, seed=3)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    top = tmp_path_factory.mktemp("raters")
    folders = write_folders(top)
    with pytest.MonkeyPatch.context() as patch:  # of 100 secrets some leave a truth outside
        patch.setattr("palpate.preference.making.secrets.token_hex", lambda size: "07" * size)
        folders.make(top / "study", items=6, raters=RATERS, size=48, names=[*STRENGTHS])
    return top / "study"


def require_recovered(results):
    """Every planted preference lies in the interval of its comparison."""
    compared = results.settings["preference"]["comparisons"]
    assert len(compared) == 3
    for row in compared:
        low, high = row["interval"]
        assert low <= CROWD.preference(row["a"], row["b"]) <= high, row


@pytest.mark.parametrize(("until", "shown"), [("2020-01-31", "#end"), ("2099-12-31", "#trial")])
def test_served_the_clock_of_the_server_ends_the_study(chromium, tmp_path, until, shown):
    public = pair_study(3, 1, until=until)[0]
    with Serving(tmp_path, public) as running, opened(chromium) as context:
        page = context.new_page()
        page.clock.install(time="2010-01-01" if shown == "#end" else "2101-01-01")  # the rater's
        page.goto(f"{running.url}?token={running.tokens['r01']}")
        if shown == "#trial":
            page.click("#begin button")
        page.wait_for_selector(f"{shown}:not([hidden])")


@pytest.mark.nightly
def test_raters_at_the_page_from_disk_are_recovered(chromium, study, tmp_path):
    plan = Plan.load(study)
    url = (study / "study.html").as_uri()
    downloads = rate(chromium, CROWD, plan, lambda code: url)
    votes = {(d["rater"], v["trial"]): v["choice"] for d in downloads for v in d["votes"]}
    assert votes == planted(CROWD, plan)
    for download in downloads:
        (tmp_path / f"{download['rater']}.json").write_text(json.dumps(download))
    require_recovered(preference.score(study, tmp_path, replicates=400))


@pytest.mark.nightly
def test_raters_at_the_server_are_recovered(chromium, study, tmp_path):
    plan = Plan.load(study)
    with Serving(tmp_path, plan.public()) as server:
        rate(chromium, CROWD, plan, lambda code: f"{server.url}?token={server.tokens[code]}")
        votes = {
            (code, v["trial"]): v["choice"]
            for code in server.tokens
            for v in server.json("GET", "/votes", code)[1]["votes"]
        }
    assert votes == planted(CROWD, plan)
    require_recovered(preference.score(study, server.database, replicates=400))


@pytest.fixture
def server(tmp_path):
    with Serving(tmp_path, pair_study(6, 2)[0]) as running:
        yield running


def stored(server, rater="r01"):
    return [vote["choice"] for vote in server.json("GET", "/votes", rater)[1]["votes"]]


def invited(context, server, rater="r01"):
    return Person(context.new_page(), f"{server.url}?token={server.tokens[rater]}")


def settled(person):
    person.page.get_by_text("All votes are at the server.", exact=True).wait_for()


def test_no_method_stands_in_page_urls_or_headers(chromium, study, tmp_path):
    plan = Plan.load(study)
    with Serving(tmp_path, plan.public()) as server, opened(chromium) as context:
        texts = []
        context.on("response", lambda r: texts.extend([r.url, str(r.all_headers())]))
        person = invited(context, server, plan.raters[0].code)
        person.press("1")
        settled(person)
        page = person.page
        texts += [page.content(), page.inner_text("body"), str(context.urls)]
        texts += [str(context.storage_state()), (study / "study.html").read_text()]
        texts += [server.request("GET", "/study.json", plan.raters[1].code)[2].decode()]
        names = {*plan.methods, *(n for i in plan.items for n in (i.id, i.material, i.video))}
        bare = [re.sub(r"base64,[\w+/=]+", "", text) for text in texts]
        assert not [name for name in names for text in bare if name in text]


def test_another_device_goes_on_where_the_first_stopped(chromium, server):
    with opened(chromium) as context:
        person = invited(context, server)
        person.press("1")
        person.press("2")
        trial = person.trial
        settled(person)
    with opened(chromium) as context:
        page = context.new_page()
        page.goto(f"{server.url}?token={server.tokens['r01']}")
        page.get_by_text("Continue, 2 of 6 done").wait_for()
        person = Person(page)
        person.start()
        assert person.trial == trial
        person.finish(lambda trial: "3")
        settled(person)
        assert "You may close this page." in page.inner_text("#end")
    assert sorted(stored(server)) == ["left", "right", *["same"] * 4]


def test_votes_wait_in_the_page_while_the_server_is_down_or_its_disk_full(chromium, server):
    with opened(chromium, quiet=False) as context:
        person, port = invited(context, server), server.port
        person.press("1")
        settled(person)
        server.kill()
        person.press("2")
        person.press("3")
        assert "2 votes not yet at the server" in person.page.inner_text("#kept")
        server.start(port=port)
        settled(person)
        assert sorted(stored(server)) == ["left", "right", "same"]
        pid, unlimited = server.process.pid, resource.prlimit(0, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, unlimited[1]))
        person.press("2")
        person.page.get_by_text("1 vote not yet at the server").wait_for()
        assert sorted(stored(server)) == ["left", "right", "same"]
        resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
        settled(person)
        assert sorted(stored(server)) == ["left", "right", "right", "same"]


def test_an_undone_vote_is_replaced_at_the_server(chromium, server):
    with opened(chromium) as context:
        person = invited(context, server)
        person.press("1")
        settled(person)
        person.press("u")
        assert stored(server) == ["left"]
        person.press("3")
        settled(person)
    (vote,) = server.json("GET", "/votes", "r01")[1]["votes"]
    assert (vote["choice"], vote["undone"]) == ("same", 1)


def test_a_vote_that_a_proxy_takes_or_the_server_refuses_stays_in_the_page(chromium, server):
    with opened(chromium, quiet=False) as context:
        person = invited(context, server)
        person.page.route("**/vote", lambda route: route.fulfill(status=200, body="<p>Sign in"))
        with person.page.expect_response("**/vote"):
            person.press("1")
        person.page.get_by_text("1 vote not yet at the server").wait_for()
        assert "All votes" not in person.page.inner_text("#kept")
        person.page.unroute("**/vote")
        settled(person)
        person.page.route("**/vote", lambda route: route.fulfill(status=400, json={"error": ""}))
        person.press("2")
        person.page.get_by_text("The server refused 1 vote: download your votes.").wait_for()
        assert list(person.choices().values()) == ["left", "right"]
        person.page.unroute("**/vote")
        person.page.reload()  # with another link, say: it is sent again
        settled(person)
    assert sorted(stored(server)) == ["left", "right"]


def test_a_guessed_invitation_opens_nothing(chromium, server):
    page = chromium.new_page()
    assert page.goto(f"{server.url}?token=guessed").status == 403
    assert "Open the link of your invitation." in page.inner_text("body")
    page.close()
