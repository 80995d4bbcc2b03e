"""The page of a study as text: one file, nothing to request, no name, no markup of strangers."""

import base64
import hashlib
import json
import re

import pytest

from forge.people import pair_study, sort_study
from palpate.preference.page import policy, study_page

STUDIES = {"pair": pair_study(3, 2)[0], "sort": sort_study()}


def inlined(page):
    (text,) = re.findall(r'<script type="application/json" id="study">(.*?)</script>', page, re.S)
    return json.loads(text)


@pytest.mark.parametrize("task", STUDIES)
def test_the_page_holds_the_study_and_requests_nothing(task):
    page = study_page(STUDIES[task])
    assert inlined(page) == STUDIES[task]
    assert re.findall(r"(?:https?:|src=|@import|url\()", page) == []
    assert re.findall(r'href="(.*?)"', page) == ["data:,"]


def test_a_served_page_holds_no_study():
    page = study_page(STUDIES["pair"], served=True)
    assert inlined(page) is None
    assert STUDIES["pair"]["study"] not in page


@pytest.mark.parametrize("served", [False, True])
def test_the_policy_allows_the_own_script_and_style_alone(served):
    page = study_page(STUDIES["pair"], served=served)
    rules = dict(rule.split(" ", 1) for rule in policy(served=served).split("; "))
    for tag in ("script", "style"):
        (text,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.S)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert rules[f"{tag}-src"] == f"'sha256-{digest}'"
    assert (rules["default-src"], rules["img-src"]) == ("'none'", "data:")
    assert rules["connect-src"] == ("'self'" if served else "'none'")
    assert f'content="{policy(served=served)}"'.replace("'", "&#39;") in page


def test_names_of_strangers_become_no_markup():
    evil = "</script><script>alert(1)</script><!--&{{ title }}"
    study = sort_study(materials=[evil, "Wood"], title=evil, question=evil)
    page = study_page(study)
    assert page.count("<script") == 2
    assert "alert(1)</script>" not in page
    assert inlined(page) == study
