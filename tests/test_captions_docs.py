"""The page about captions: its commands run against a local server, its flags exist."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from forge.servers import FakeServer
from palpate.cli import main
from palpate.core import Split
from palpate.sim import WorldOptions, write_world

PAGE = Path(__file__).resolve().parents[1] / "docs" / "captions.md"


@pytest.mark.slow
def test_the_blocks_of_the_page_run(tmp_path, monkeypatch, capsys):
    options = WorldOptions(
        materials=3, objects_per_material=4, contacts_per_video=2, frames_per_contact=2, test=0.4
    )
    write_world(tmp_path / "data", options)
    monkeypatch.chdir(tmp_path)
    shutil.copy("data/splits/Orig.json", "noleak.json")
    assert Split.load("noleak.json").counts()["test"]
    text = PAGE.read_text(encoding="utf-8")
    with FakeServer(model="allenai/Molmo-7B-D-0924") as server:
        for block in re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            for line in block.replace("http://localhost:8000/v1", server.url).splitlines():
                assert main(shlex.split(line)[1:]) == 0, line
    for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        exec(compile(block, str(PAGE), "exec"), {})
    assert "material accuracy from the text" in capsys.readouterr().out
    # What is trained on the captions names them.
    digest = json.loads(Path("captions/record.json").read_text())["digest"][:12]
    for words, part in (
        ("encoder captioned -o encoders", "card"),
        ("generator captioned --clip encoders --steps 2 -o model", "training"),
    ):
        line = f"train {words} --split captioned/splits/Orig.json --preset tiny -q"
        assert main(shlex.split(line)) == 0, capsys.readouterr().err
        facts = json.loads(Path(words.split()[-1], "palpate.json").read_text())[part]
        assert digest in facts["text_source"]


@pytest.mark.parametrize("verb", ["caption", "caption check"])
def test_every_option_has_an_example(verb, capsys):
    with pytest.raises(SystemExit):
        main([*verb.split(), "--help"])
    options = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", capsys.readouterr().out)) - {"--help"}
    text = PAGE.read_text(encoding="utf-8")
    examples = " ".join(
        re.findall(r"^```(?:sh|console)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    )
    short = {"--output": "-o", "--quiet": "-q"}
    assert len(options) > 8
    assert [o for o in sorted(options) if short.get(o, o) not in examples.split()] == []


def test_every_flag_of_a_caption_has_an_example():
    flags = re.findall(r"^\| `([a-z-]+)` \| ", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    sources = (PAGE.parents[1] / "src" / "palpate" / "captions").glob("*.py")
    code = "".join(path.read_text(encoding="utf-8") for path in sources)
    assert all(f'"{flag}"' in code for flag in flags)
    assert len(flags) == 9
