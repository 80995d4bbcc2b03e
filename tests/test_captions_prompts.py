"""Prompts and replies: prompt files, and what a reply of any form says."""

import json

import pytest

from palpate.captions import Prompt
from palpate.core import PalpateError

GOOD = '{"adjectives": ["Rough", "hard ", "gritty."], "surface_visible": true}'
HEAD = "name: mine/1\nreply: sentence\ntext: sentence\n\nAnswer with a sentence."


@pytest.fixture
def adjectives():
    return Prompt.load("touch-adjectives/1")


@pytest.mark.parametrize("name", ["touch-adjectives/1", "touch-sentence/1"])
def test_shipped_prompts_tell_of_hand_and_sensor_and_ask_for_every_field(name):
    prompt = Prompt.load(name)
    assert prompt.name == name
    assert all(word in prompt.body for word in ("hand", "sensor", *prompt.fields))
    assert prompt.schema["required"] == list(prompt.fields)
    assert prompt.schema["additionalProperties"] is False


def test_digest_is_of_what_the_model_gets_not_of_the_name():
    one, two = Prompt.parse(HEAD), Prompt.parse(HEAD.replace("mine/1", "yours/7"))
    assert one.digest == two.digest != Prompt.parse(HEAD + " Please.").digest


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("Describe it.", "no line that begins with 'name:'"),
        (HEAD.replace("text: sentence\n", ""), "no line that begins with 'text:'"),
        (HEAD.replace("reply: sentence", "reply: color"), "'color' is none of"),
        (HEAD.replace("text: sentence", "text: adjectives"), "not one of sentence"),
        (HEAD.replace("Answer with a sentence.", "Go."), "does not request the field 'sentence'"),
        (HEAD.replace("reply: sentence", "reply: surface_visible"), "a reply field with a text"),
        (b"\xff\xfe\x00", "utf-8"),
    ],
)
def test_a_prompt_file_without_what_the_schema_needs_is_an_error(tmp_path, text, got):
    path = tmp_path / "prompt.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(PalpateError, match=got) as caught:
        Prompt.load(path)
    assert caught.value.argument == "prompt"


def test_unknown_prompt_names_those_that_ship():
    with pytest.raises(PalpateError, match="touch-adjectives/1, touch-sentence/1"):
        Prompt.load("touch/9")


@pytest.mark.parametrize(
    ("raw", "text", "flags"),
    [
        (GOOD, "rough, hard, gritty", ()),
        (GOOD.replace("true", "false"), "rough, hard, gritty", ("surface-hidden",)),
        (f"Sure!\n```json\n{GOOD}\n```", "rough, hard, gritty", ("schema-ignored",)),
        (f"<think>It is {{soft}}.</think>{GOOD}", "rough, hard, gritty", ()),
        ('{"adjectives": ["rough", "rough", "hard"], "surface_visible": true}', "rough, hard", ()),
        ('{"adjectives": ["rough"]}', "rough", ("schema-ignored",)),
        ("rough, hard, gritty", None, ("invalid",)),
        (GOOD[:30], None, ("invalid",)),
        ("", None, ("invalid",)),
        ('{"adjectives": "rough"}', None, ("invalid",)),
        ('{"adjectives": []}', None, ("invalid",)),
        (json.dumps({"adjectives": [f"a{k}" for k in range(99)]}), None, ("invalid",)),
        ("[1, 2]", None, ("invalid",)),
        ("{" * 100_000, None, ("invalid",)),
        ("I'm sorry, but I can't help with that.", None, ("refusal",)),
        ('{"adjectives": ["I cannot see an image"]}', None, ("refusal",)),
    ],
)
def test_replies(adjectives, raw, text, flags):
    description = adjectives.read(raw)
    assert (description.text, description.flags) == (text, flags)
    assert description.answered is (text is not None or "refusal" in flags)


def test_a_sentence_keeps_its_case_and_loses_line_breaks_and_its_full_stop():
    raw = '{"sentence": "Rough, bumpy\\n surface typical of concrete.", "surface_visible": true}'
    description = Prompt.load("touch-sentence/1").read(raw)
    assert description.text == "Rough, bumpy surface typical of concrete"
    assert description.flags == ()


def test_a_refusal_by_the_server_counts_whatever_its_words(adjectives):
    assert adjectives.read("No.", refused=True).flags == ("refusal",)
