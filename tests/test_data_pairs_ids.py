"""Tables whose ids, parts or groups are in doubt: which row keeps an id, which part it is in, and words that mean null."""

from palpate.data.importing import validate_dataset
from test_data_pairs import images, import_pairs, problems_of

__all__ = ["images"]


def test_words_for_null_in_groups_are_told_with_their_number(images, tmp_path):
    table = images / "t.csv"
    words = ["NA", "nan", "None", "NULL", "Nantes", "x"]
    table.write_text(
        "vision,tactile,video,object,material\n"
        + "".join(f"v/{k}.jpg,t/{k}.jpg,{w},cup,none\n" for k, w in enumerate(words))
    )
    found = import_pairs(table, tmp_path / "out")
    assert [p.kind for p in found.suspicious] == ["word-for-null"]
    assert found.suspicious[0].text.startswith("4 of 6 rows have the video")
    assert f"{table}:2" in found.suspicious[0].text


def test_parts_are_those_of_the_rows_that_stay_and_an_id_of_two_parts_is_in_neither(
    images, tmp_path
):
    table = images / "dup.csv"
    lines = [
        "id,vision,split",
        "a,v/0.jpg,train",
        "a,v/2.jpg,test",
        "c,v/3.jpg,test",
        "c,v/none.jpg,train",
        "d,v/4.jpg,",
        "d,v/5.jpg,train",
    ]
    table.write_text("\n".join([*lines, "e,v/5.jpg,test", "e,v/1.jpg,test"]))
    found = import_pairs(table, tmp_path / "out", skip_bad=True)
    assert [(p.where.rpartition(":")[2], p.kind) for p in found.skipped] == [
        ("3", "two-parts"),
        ("5", "missing-file"),
        ("7", "duplicate-id"),
        ("9", "duplicate-id"),
    ]
    rows = dict(zip(found.manifest.ids, found.manifest.column("vision"), strict=True))
    assert rows == {"a": "v/0.jpg", "c": "v/3.jpg", "d": "v/4.jpg", "e": "v/5.jpg"}
    assert dict(found.splits["Orig"].parts) == {"c": "test", "e": "test"}


def test_a_bad_row_takes_no_id_from_a_good_one(images, tmp_path):
    (images / "v" / "0.jpg").write_bytes((images / "v" / "0.jpg").read_bytes()[:-300])
    table = images / "dup.csv"
    table.write_text("id,vision\na,v/0.jpg\na,v/1.jpg\n")
    assert problems_of(table) == [("2", "bad-image")]
    assert import_pairs(table, tmp_path / "out", skip_bad=True).manifest.column("vision") == [
        "v/1.jpg"
    ]
    table.write_text("vision,tactile\nv/2.jpg,t/1.jpg\nv/3.jpg,t/1.jpg\n")
    (problem,) = validate_dataset(table).invalid
    assert (problem.where, problem.kind) == (f"{table}:3", "duplicate-id")
    assert problem.text.endswith("made of the path since there is none: map a column to id")
