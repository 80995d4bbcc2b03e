"""`palpate report` on audit files: with further audits in them, of earlier versions, and with something wrong in them."""

import dataclasses
import json
import re

import pytest

from audit_samples import full_audit, pictures, pretraining_audit
from palpate.cli import main
from test_report_page import Tree, an_audit


def audit_file(folder, audit, **more):
    data = {
        "format": "palpate-audit/2",
        **json.loads(json.dumps(dataclasses.asdict(audit))),
        **more,
    }
    path = folder / "audit.json"
    path.write_text(json.dumps(data))
    return path, data


def test_command_takes_audits_with_others_and_a_page_of_them(capsys, tmp_path):
    other = json.loads(json.dumps(dataclasses.asdict(pretraining_audit())))
    path, _ = audit_file(
        tmp_path,
        full_audit(pictures(tmp_path, 8, 32)),
        others=[other],
        skipped=["a line"],
        failed=True,
    )
    assert main(["report", str(path), "-o", str(tmp_path / "page.html"), "-q"]) == 0
    tree = Tree((tmp_path / "page.html").read_text())
    assert "Test against the pretraining data pretrain.csv / test" in tree.text
    assert len(tree.all("img")) == 4 * (3 + 4 + 8 + 8 + 8)
    assert (
        main(["report", str(tmp_path / "page.json"), "-o", str(tmp_path / "again.html"), "-q"]) == 0
    )
    assert (tmp_path / "again.html").read_text().replace("again.", "page.") == (
        tmp_path / "page.html"
    ).read_text()
    old, _ = audit_file(tmp_path, an_audit())
    data = json.loads(old.read_text())
    for name in (
        "against",
        "signals",
        "leaking_samples",
        "matrix",
        "groups_in_all",
        "impact",
        "commands",
    ):
        del data[name]
    old.write_text(json.dumps(data))
    assert main(["report", str(old), "-o", str(tmp_path / "old.html"), "-q"]) == 0
    capsys.readouterr()


def broken():
    def put(data, place, value):
        *way, last = place
        for step in way:
            data = data[step]
        data[last] = value

    cases = [
        (("new",), 1, "new"),
        (("signals", 0, "odd"), 1, "odd"),
        (("signals",), 5, "int"),
        (("impact",), {"rows": []}, "clean_splits"),
        (("others",), 3, "int"),
        (("others",), [{"name": "x"}], "missing"),
    ]
    return [
        pytest.param(put, place, value, said, id=".".join(map(str, place)) + f"={value!r:.9}")
        for place, value, said in cases
    ]


@pytest.mark.parametrize(("put", "place", "value", "said"), broken())
def test_command_names_what_is_wrong_with_an_audit(capsys, tmp_path, put, place, value, said):
    path, data = audit_file(tmp_path, full_audit(["p.png"]))
    put(data, place, value)
    path.write_text(json.dumps(data))
    assert main(["report", str(path), "-o", str(tmp_path / "page.html"), "-q"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "must hold complete results" in told
    assert re.search(said, told), told
    assert "Traceback" not in told
    assert not (tmp_path / "page.html").exists()


def test_command_names_a_missing_field(capsys, tmp_path):
    path, data = audit_file(tmp_path, full_audit())
    for place in (data, data["signals"][0], data["impact"], data["impact"]["rows"][0]):
        name, value = next(
            iter((k, v) for k, v in place.items() if k in ("name", "kind", "group", "features"))
        )
        del place[name]
        path.write_text(json.dumps(data))
        assert main(["report", str(path), "-o", str(tmp_path / "page.html"), "-q"]) == 2
        assert name in capsys.readouterr().err
        place[name] = value
    path.write_text(json.dumps(data))
    assert main(["report", str(path), "-o", str(tmp_path / "page.html"), "-q"]) == 0
