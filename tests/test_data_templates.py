"""Path templates: what they match, what they join, and what is told."""

import pytest

from forge.errors import fails
from palpate.data.templates import Template, assign, join, walk


@pytest.mark.parametrize(
    ("template", "path", "fields"),
    [
        ("{object}/photo/{frame}.jpg", "cup/photo/0007.jpg", {"object": "cup", "frame": "7"}),
        ("{object}/photo/{frame}.jpg", "cup/photo/x.jpg", None),
        ("{object}/photo/{frame}.jpg", "a/cup/photo/7.jpg", None),  # a field is one name
        ("./{object}_{video}.mov", "big_cup_2.mov", {"object": "big_cup", "video": "2"}),
        ("{object}{frame:d}.png", "cup12.png", {"object": "cup", "frame": "12"}),
        ("{video}/{frame:d}*.png", "v/12-0.5.png", {"video": "v", "frame": "12"}),
        ("2024{frame:d}.png", "202407.png", {"frame": "7"}),
        ("{video}/*/{frame}.png", "v/left/1.png", {"video": "v", "frame": "1"}),
        ("{video}/{cam|rgb.1}/{frame}.png", "v/rgb.1/1.png", {"video": "v", "frame": "1"}),
        ("{video}/{cam|rgb.1}/{frame}.png", "v/rgbx1/1.png", None),
        ("{video}/**/{frame}.png", "v/1.png", {"video": "v", "frame": "1"}),
        ("{video}/**/{frame}.png", "v/a/b/1.png", {"video": "v", "frame": "1"}),
        ("t/{video:**}/{frame}.png", "t/a/b/1.png", {"video": "a/b", "frame": "1"}),
        ("t/{video:**}/{frame}.png", "t/1.png", {"frame": "1"}),
        ("t/{all:**}", "t/a/1.png", {"all": "a/1.png"}),
        ("t/**", "t/a/1.png", {}),
        ("t/{frame}", "t/1.png", {"frame": "1"}),  # any suffix
        ("{a}/{a}.png", "x/x.png", {"a": "x"}),
        ("{a}/{a}.png", "x/y.png", None),
        ("a[1]+/{b}.png", "a[1]+/x\n.png", {"b": "x\n"}),
    ],
)
def test_templates_match_paths(template, path, fields):
    assert Template.parse(template).match(path) == fields


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "/a/{x}.png",
        "../{x}.png",
        "a/",
        "{x",
        "x}",
        "{}",
        "{1}",
        "{x:e}",
        "{x!r}",
        "{x}{y}.png",
        "*{y}.png",
        "{vision}/{frame}.png",  # the columns of the paths themselves
        "{tactile:d}.png",
        "{background:**}/{frame}.png",
    ],
)
def test_malformed_templates_are_errors(text):
    fails("", Template.parse, text)


def test_walking_skips_hidden_files_and_follows_links_once(tmp_path):
    for path in ("d/b/2.png", "d/b/10.png", "d/.h/1.png", "d/a.png", "d/.x.png", "far/1.png"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    (tmp_path / "d" / "b" / "circle").symlink_to(tmp_path / "d")
    (tmp_path / "d" / "out").symlink_to(tmp_path / "far")
    assert walk(tmp_path / "d") == (["a.png", "b/10.png", "b/2.png", "out/1.png"], ["b/circle"])


def sides(**templates):
    """The matches of templates among files that are named below."""
    files = ["cup/v/1.jpg", "cup/v/2.jpg", "cup/t/1.png", "cup/t/3.png", "mug/v/1.jpg"]
    files += ["mug/t/1.png", "mug/bg.png", "all.png"]
    return assign(files, {side: Template.parse(text) for side, text in templates.items()})


def test_equal_fields_join_and_what_a_side_lacks_is_named():
    rows, problems = join(
        sides(
            tactile="{object}/t/{frame}.png",
            vision="{object}/v/{frame}",
            background="{object}/bg.png",
        )
    )
    assert rows == [
        {"object": "cup", "frame": "1", "tactile": "cup/t/1.png", "vision": "cup/v/1.jpg"},
        {"object": "mug", "frame": "1", "tactile": "mug/t/1.png", "vision": "mug/v/1.jpg"}
        | {"background": "mug/bg.png"},
    ]
    assert [(p.where, p.kind, p.text) for p in problems] == [
        ("cup/t/3.png", "unpaired", "no vision image with frame=3, object=cup"),
        ("cup/v/2.jpg", "unpaired", "no tactile image with frame=2, object=cup"),
    ]


def test_one_file_may_serve_many_but_many_serve_many_only_by_a_field():
    rows, problems = join(sides(tactile="{object}/t/{frame}.png", background="all.png"))
    assert {row["background"] for row in rows} == {"all.png"}
    assert (len(rows), problems) == (3, [])
    rows, problems = join(sides(tactile="{object}/t/*", vision="{object}/v/*"))
    assert [row["object"] for row in rows] == ["mug"]
    assert [p.kind for p in problems] == ["ambiguous"] * 2
    assert problems[0].text.startswith("2 tactile and 2 vision images with object=cup")
    fails("must share a field", join, sides(tactile="*/t/{frame}.png", vision="{object}/v/*.jpg"))


def test_a_file_belongs_to_the_template_that_spells_out_most():
    matches = assign(
        ["a.png", "a_real.png"],
        {"vision": Template.parse("{name}.png"), "tactile": Template.parse("{name}_real.png")},
    )
    assert matches == {
        "vision": [("a.png", {"name": "a"})],
        "tactile": [("a_real.png", {"name": "a"})],
    }
