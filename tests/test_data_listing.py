"""Frame lists: corners of the format, every kind of bad line, facts of the official lists."""

import time

import numpy as np
import pytest

from forge.errors import fails
from palpate.data.listing import is_list, read_frame_table, read_list, read_lists, write_list
from palpate.data.recordings import contact_names
from palpate.data.tables import read_categories


def write(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def places(problems):
    return [(p.where, p.kind) for p in problems]


def slow_contacts(videos, frames, labels):
    """One by one, by looking for the row of the frame before."""
    at = {(v, f): label for v, f, label in zip(videos, frames, labels, strict=True)}
    names = {}
    for video in set(videos):
        count = 0
        for v, f in sorted(k for k in at if k[0] == video):
            count += at.get((v, f - 1)) != at[v, f]
            names[v, f] = f"{v}#{count:04d}"
    return [names[v, f] for v, f in zip(videos, frames, strict=True)]


def test_bom_crlf_no_last_newline_commas_spaces_and_other_letters(tmp_path):
    text = "\ufeffa, b/0000000007.jpg,3\r\n\r\nвидео 1/8.PNG, 12\r\n  v/9.jpeg,-1  \r\nv/10.jpg,0"
    listed = read_list(write(tmp_path / "l.txt", text))
    assert listed.manifest.ids == ["a, b/0000000007", "видео 1/8", "v/10"]
    assert listed.manifest.column("video") == ["a, b", "видео 1", "v"]
    assert listed.manifest.column("frame") == [7, 8, 10]
    assert listed.manifest.column("material") == ["3", "12", "0"]
    assert listed.manifest.column("vision") == [None] * 3
    assert listed.manifest.root == tmp_path
    assert listed.inconclusive == 1
    assert listed.rows["line"].to_list() == [1, 3, 5]
    assert sorted(listed.contact.rows()) == [("a, b", 7), ("v", 9), ("v", 10), ("видео 1", 8)]


BAD = {
    2: ("v/0000000002.jpg", "no-comma"),
    3: ("v/0000000003.jpg,wood", "bad-label"),
    4: ("0000000004.jpg,3", "bad-path"),
    5: ("a/v/0000000005.jpg,3", "bad-path"),
    6: ("v/frame6.jpg,3", "bad-frame"),
    7: ("../0000000007.jpg,3", "outside-root"),
    8: ("/v/0000000008.jpg,3", "outside-root"),
    9: ("v/../../x/0000000009.jpg,3", "outside-root"),
    10: ("v/1.jpg,3", "duplicate-row"),
    11: ("w/0000000001.jpg,3", "two-labels"),
    12: ("w/0000000001.jpg,4", "two-labels"),
    13: ("v/0000000013.jpg,-2", "unknown-label"),
    14: ("C:\\v\\0000000014.jpg,3", "outside-root"),
    15: ("v/0000000015,3", "bad-path"),
    16: ("v/0000000016.jpg,3.5", "bad-label"),
    17: ("v/99999999999999999999999.jpg,3", "bad-frame"),
    18: ("v/0000000018.jpg,", "bad-label"),
}


def test_every_bad_line_is_reported_or_skipped_with_its_place(tmp_path):
    lines = ["v/0000000001.jpg,3", *(line for line, _ in BAD.values()), "v/0000000019.jpg,5"]
    path = write(tmp_path / "bad.txt", "\n".join(lines))
    expected = [(f"{path}:{n}", kind) for n, (_, kind) in BAD.items()]
    error = fails("", read_list, path)
    assert places(error.problems) == expected
    listed = read_list(path, skip_bad=True)
    assert listed.manifest.ids == ["v/0000000001", "v/0000000019"]
    assert places(listed.skipped) == expected
    assert f"4 at {path}:12" in listed.skipped[9].text


@pytest.mark.parametrize(
    ("content", "place", "kind"),
    [("\n \n", "", "empty-list"), (b"v\xc3\xa9/1.jpg,3\nv\xe9/2.jpg,3\n", ":2", "bad-encoding")],
)
def test_empty_lists_and_foreign_bytes(tmp_path, content, place, kind):
    path = write(tmp_path / "l.txt", content)
    error = fails("", read_list, path)
    assert places(error.problems) == [(f"{path}{place}", kind)]


def test_missing_lists_and_inconclusive_ones(tmp_path):
    fails("no file", read_list, tmp_path / "none.txt")
    fails("folder", read_list, tmp_path)
    listed = read_list(write(tmp_path / "unclear.txt", "v/1.jpg,-1\n"))
    assert (len(listed.manifest), listed.inconclusive, listed.skipped) == (0, 1, [])


def test_categories_next_to_the_list_name_the_material_and_reject_other_labels(tmp_path):
    write(tmp_path / "category_reference.txt", "Inconclusive: -1 (no)\nWood: 3\nRuber: 10\n")
    path = write(tmp_path / "l.txt", "v/1.jpg,3\nv/2.jpg,10\nv/3.jpg,11\nv/4.jpg,-1\n")
    error = fails("", read_list, path)
    assert places(error.problems) == [(f"{path}:3", "unknown-label")]
    assert read_list(path, skip_bad=True).manifest.column("material") == ["Wood", "Rubber"]
    listed = read_list(path, categories={3: "x", 10: "y", 11: "z"})
    assert listed.manifest.column("material") == ["x", "y", "z"]


def test_joined_lists_detect_a_frame_in_both(tmp_path):
    a = write(tmp_path / "a.txt", "v/1.jpg,3\nv/2.jpg,3")
    b = write(tmp_path / "b.txt", "v/0002.jpg,3\nv/1.jpg,4\nv/3.jpg,3")
    listed = read_lists([a, b], root=tmp_path, skip_bad=True)
    kinds = [(f"{a}:1", "two-labels"), (f"{b}:1", "duplicate-row"), (f"{b}:2", "two-labels")]
    assert places(listed.skipped) == kinds
    assert listed.manifest.column("contact") == ["v#0001", "v#0001"]


def test_contacts_by_hand_and_against_a_slow_count():
    videos, frames, labels = list("bbbaabba"), [5, 4, 9, 1, 2, 6, 7, 4], [0, 0, 0, 1, 1, 2, 2, 1]
    names = [f"{v}#000{k}" for v, k in zip(videos, (1, 1, 3, 1, 1, 2, 2, 2), strict=True)]
    assert contact_names(videos, frames, labels).to_list() == names
    assert contact_names(videos, frames, None)[5] == "b#0001"
    rng = np.random.default_rng(0)
    cells = rng.permutation([(v, f) for v in range(3) for f in range(200) if rng.random() < 0.8])
    videos, frames = [f"v{v}" for v, _ in cells], [int(f) for _, f in cells]
    labels = [int(f // 17) for f in frames]
    assert contact_names(videos, frames, labels).to_list() == slow_contacts(videos, frames, labels)
    assert contact_names([], [], []).to_list() == []


def test_write_list_can_be_read_back_and_rejects_what_could_not(tmp_path):
    write_list(tmp_path / "l.txt", [("a.b/0000000001", 3), ("c/2.png", 4)])
    assert (tmp_path / "l.txt").read_text() == "a.b/0000000001.jpg,3\nc/2.png,4\n"
    assert read_list(tmp_path / "l.txt").manifest.ids == ["a.b/0000000001", "c/2"]
    error = fails("", write_list, tmp_path / "m.txt", [("v/1", 3), ("photo", 3), ("v/x", 3)])
    assert [p.where for p in error.problems] == ["row 2", "row 3"]
    assert not (tmp_path / "m.txt").exists()


def test_category_table_with_remarks_quotes_and_a_misspelling(tmp_path):
    text = "Inconclusive: -1 (Do not use)\nWood: 3 \nMetal:4\n'Synthetic  Fabric' : 8\n"
    text += '"Ruber": 10,\nOthers: 19'
    names = {-1: "Inconclusive", 3: "Wood", 4: "Metal", 8: "Synthetic Fabric", 10: "Rubber"}
    assert read_categories(write(tmp_path / "c.txt", text)) == names | {19: "Others"}
    path = write(tmp_path / "d.txt", "Wood: 3\nStone\nIron: 3\n")
    error = fails("", read_categories, path)
    kinds = [(f"{path}:2", "bad-line"), (f"{path}:3", "duplicate-id")]
    assert places(error.problems) == kinds
    fails("empty", read_categories, write(tmp_path / "e.txt", "\n"))


@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lists_of_other_tools(tmp_path, code, end):
    name = "gr\u00f6\u00dfe\u2028 a"  # a line separator that is not the end of a line
    path = tmp_path / "l.txt"
    lines = [f"{name}/0001.jpg,3", "", f"{name}/2.jpg,4", "nonsense", "v/3.jpg,5", ""]
    path.write_bytes(end.join(lines).encode(code))
    listed = read_list(path, skip_bad=True)
    assert listed.manifest.ids == [f"{name}/0001", f"{name}/2", "v/3"]
    assert listed.rows["line"].to_list() == [1, 3, 5]
    assert places(listed.skipped) == [(f"{path}:4", "no-comma")]
    assert is_list(path)
    path.write_bytes(end.join(["Wood: 3", "Rock: 4"]).encode(code))
    assert read_categories(path) == {3: "Wood", 4: "Rock"}


def test_words_for_frames(tmp_path):
    text = 'frame,text\nv/0001.jpg,"hard, cold"\nv/2.jpg,soft, warm\n'
    text += "x,hard\nv/3.jpg,\nv/1.jpg,soft\n"
    path = write(tmp_path / "captions.csv", text)
    problems = []
    assert read_frame_table(path, problems) == {("v", 1): "hard, cold", ("v", 2): "soft, warm"}
    kinds = enumerate(("bad-path", "bad-line", "two-labels"), 4)
    assert places(problems) == [(f"{path}:{k}", kind) for k, kind in kinds]


@pytest.mark.parametrize("stray", ['v/3.jpg,"soft', '"v/3.jpg,soft', 'v/3.jpg,soft"'])
def test_a_stray_quote_costs_at_most_its_own_caption(tmp_path, stray):
    lines = [f'v/{k}.jpg,"hard, cold"' if k != 3 else stray for k in range(9)]
    problems = []
    words = read_frame_table(write(tmp_path / "captions.csv", "\n".join(lines)), problems)
    assert set(words) | {("v", 3)} == {("v", k) for k in range(9)}
    assert len(words) + len(problems) == 9


def test_facts_of_the_official_lists(real_data):
    folder = real_data / "touch_and_go" / "lists"
    train, test = read_list(folder / "train.txt"), read_list(folder / "test.txt")
    start = time.perf_counter()
    both = read_lists([folder / "train.txt", folder / "test.txt"], root=folder)
    assert time.perf_counter() - start < 2  # some 0.25 s on an idle core
    runs = [f.manifest.table["contact"].n_unique() for f in (train, test, both)]
    assert [len(f.manifest) for f in (train, test, both)] == [91_982, 29_879, 121_861]
    assert runs == [3_378, 1_113, 4_491]
    table = both.manifest.table.with_columns(source=both.rows["source"])
    by_contact = table.group_by("contact").n_unique()
    assert by_contact["source"].max() == 1
    assert by_contact["material"].max() == 1
    assert train.manifest.table["video"].n_unique() == 120
    assert both.manifest.table["video"].n_unique() == 126
    assert both.manifest.table["material"].n_unique() == 19
    lengths = both.manifest.table["contact"].value_counts()["count"]
    assert (lengths.median(), lengths.max()) == (27, 86)
